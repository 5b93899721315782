/** What can go wrong with a request. */
export class ApiError extends Error {
  /**
   * @param {number} status 0 where nothing answered
   * @param {string} code stable, as in docs/errors.md
   * @param {string} message for people
   */
  constructor(status, code, message) {
    super(message);
    this.status = status;
    this.code = code;
  }
}

/** The code of an error after `leave`: nobody waits for the answer any more. */
export const LEFT = 'left';
/** People that are listed at most. */
export const MOST_USERS = 1000;
const PAGE = 200;
/** Longest wait for an answer, and for that to an upload. */
const PATIENCE_MS = { usual: 10_000, upload: 120_000 };

/** The REST routes that the viewer uses. */
export class Api {
  #visit = new AbortController();

  /**
   * @param {URL} url of the service
   * @param {() => string} key
   */
  constructor(url, key) {
    this.url = url;
    this.key = key;
  }

  /** Aborted when whoever is signed in leaves. */
  get visit() { return this.#visit.signal; }

  /** End what is being asked, so that nothing of it reaches whoever signs in next. */
  leave() {
    this.#visit.abort();
    this.#visit = new AbortController();
  }

  /**
   * @param {string} method
   * @param {string} path without a leading slash
   * @param {any} [body] sent as JSON, or as it is where it is a form
   * @returns {Promise<any>}
   * @throws {ApiError}
   */
  async request(method, path, body) {
    const isForm = body instanceof FormData;
    const headers = { Accept: 'application/json' };
    if (this.key()) headers.Authorization = `Bearer ${this.key()}`;
    if (body !== undefined && !isForm) headers['Content-Type'] = 'application/json';
    const { visit } = this;
    const signal = AbortSignal.any([visit, AbortSignal.timeout(isForm ? PATIENCE_MS.upload : PATIENCE_MS.usual)]);
    let answer;
    try {
      answer = await fetch(new URL(path, this.url), {
        method, headers, body: isForm ? body : JSON.stringify(body), cache: 'no-store', signal,
      });
    } catch {
      throw visit.aborted ? goneError() : new ApiError(0, 'offline', 'The service does not answer.');
    }
    const problem = answer.ok ? null : await readProblem(answer);
    const content = problem || answer.status === 204 ? null : await answer.json().catch(() => undefined);
    if (visit.aborted) throw goneError();
    if (signal.aborted) throw new ApiError(0, 'offline', 'The service does not answer in time.');
    if (problem) throw problem;
    if (content === undefined) throw new ApiError(502, 'unreadable', `The answer to ${path} is no JSON.`);
    return content;
  }

  async #list(path) {
    return (await this.request('GET', path)).items;
  }

  skeletons() { return this.#list('v1/skeletons'); }
  /** Everybody, up to a number that a page can hold. */
  async users() {
    const users = [];
    let query = `limit=${PAGE}`;
    for (;;) {
      const { items, next_cursor: cursor } = await this.request('GET', `v1/users?${query}`);
      users.push(...items);
      if (!cursor || users.length >= MOST_USERS) return users;
      query = `limit=${PAGE}&cursor=${encodeURIComponent(cursor)}`;
    }
  }

  user(id) { return this.request('GET', `v1/users/${encodeURIComponent(id)}`); }
  addUser(user) { return this.request('POST', 'v1/users', user); }
  changeUser(id, change) {
    return this.request('PATCH', `v1/users/${encodeURIComponent(id)}`, change);
  }
  trials(id) { return this.#list(`v1/users/${encodeURIComponent(id)}/trials?limit=20`); }
  versions(id) { return this.#list(`v1/users/${encodeURIComponent(id)}/versions?limit=50`); }
  jobs(id) { return this.#list(`v1/admin/jobs?limit=10&user=${encodeURIComponent(id)}`); }
  allJobs(state) { return this.#list(`v1/admin/jobs?limit=200&state=${state}`); }
  cancelJob(id) { return this.request('POST', `v1/admin/jobs/${id}/cancel`); }
  finetune(id) {
    return this.request('POST', `v1/admin/users/${encodeURIComponent(id)}/finetune`, {
      trials: null,
    });
  }

  /** Let a version answer; refused where another one is active than the page shows. */
  promote(id, number, activeSha256) {
    const path = `v1/admin/users/${encodeURIComponent(id)}/versions/${number}/promote`;
    return this.request('POST', path, { active_sha256: activeSha256 });
  }

  rollBack(id, activeSha256) {
    const path = `v1/admin/users/${encodeURIComponent(id)}/rollback`;
    return this.request('POST', path, { active_sha256: activeSha256 });
  }

  /** Store a recording as a trial. */
  upload(id, file, label) {
    const form = new FormData();
    form.append('label', label);
    form.append('file', file, file.name);
    return this.request('POST', `v1/users/${encodeURIComponent(id)}/trials`, form);
  }

  /**
   * Follow a job until it has ended; an `EventSource` could not send the key in a header.
   * @param {string} id
   * @param {(job: any) => void} onJob
   * @param {AbortSignal} signal
   */
  async watchJob(id, onJob, signal) {
    const answer = await fetch(new URL(`v1/admin/jobs/${id}/events`, this.url), {
      headers: { Authorization: `Bearer ${this.key()}` }, signal,
    });
    if (!answer.ok) throw await readProblem(answer);
    const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
    let pending = '';
    for (;;) {
      const { done, value } = await reader.read();
      if (done) return;
      const events = (pending + value).split('\n\n');
      pending = events.pop();
      for (const event of events) {
        const data = event.split('\n').find((line) => line.startsWith('data: '));
        if (data) onJob(JSON.parse(data.slice('data: '.length)));
      }
    }
  }
}

function goneError() {
  return new ApiError(0, LEFT, 'Signed out.');
}

async function readProblem(answer) {
  try {
    const problem = await answer.json();
    return new ApiError(answer.status, problem.code, problem.detail);
  } catch {
    return new ApiError(answer.status, 'unknown', `The service answered ${answer.status}.`);
  }
}
