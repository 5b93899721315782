import { Api, ApiError, LEFT, MOST_USERS } from './api.js';
import { SyntheticPerson } from './demo/person.js';
import { Emitter } from './emitter.js';
import { Player, readRecording } from './files/recording.js';
import { keepKey, readKey } from './key.js';
import { Performer } from './performer.js';

const DEMO = [['demo-ada', 'Ada (synthetic)'], ['demo-ben', 'Ben (synthetic)'], ['demo-cleo', 'Cleo (synthetic)']];
/** Of synthetic people. */
const SKELETON = 'kinect_v1';
const TICK_MS = 8;
const REFRESH_MS = 5000;
/** Each holds a connection, of which a browser has six for everything. */
const WATCHED_MOST = 3;
const OPEN_STATES = new Set(['queued', 'running']);
/** What goes wrong with every frame is said this often. */
const REPEAT_MS = 8000;

/**
 * What the page knows and does. Panels listen to `change` (anything), `toast` ({text, bad}) and
 * `figures` (who is in the room).
 */
export class App extends Emitter {
  #watched = new Map();
  #files = new Map();
  #said = new Map();
  #isRefreshing = false;

  constructor() {
    super();
    this.url = new URL('.', location.href);
    this.api = new Api(this.url, readKey);
    /** signed-out, loading, ready or failed */
    this.phase = 'signed-out';
    this.problem = '';
    this.isOnline = true;
    this.users = [];
    this.skeletons = [];
    this.selected = null;
    this.details = null;
    this.training = new Set();
    /** @type {Map<string, Performer>} */
    this.performers = new Map();
    this.pending = new Set();
    setInterval(() => this.performers.forEach((performer) => performer.tick()), TICK_MS);
    setInterval(() => this.refresh(), REFRESH_MS);
  }

  get user() { return this.users.find((user) => user.id === this.selected) ?? null; }
  get performer() { return this.performers.get(this.selected) ?? null; }
  get file() { return this.#files.get(this.selected) ?? null; }

  // Coming and going.

  /** @param {string} key */
  async signIn(key) {
    keepKey(key);
    await this.load();
  }

  signOut(problem = '') {
    this.api.leave();
    this.stopAll();
    this.#watched.forEach((watch) => watch.abort());
    this.#watched.clear();
    keepKey('');
    Object.assign(this, { users: [], selected: null, details: null, training: new Set() });
    this.#enter('signed-out', problem);
  }

  /** Exchange the one-time code of the terminal for a key. */
  async redeem(code) {
    try {
      const { key } = await this.api.request('POST', 'v1/viewer/redeem', { code });
      keepKey(key);
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      this.problem = error.message;
    }
    await this.load();
  }

  async load() {
    if (!readKey()) {
      this.#enter('signed-out', this.problem);
      return;
    }
    this.#enter('loading');
    try {
      this.skeletons = await this.api.skeletons();
      await this.#readUsers();
      this.#enter('ready');
      await this.select(this.users.some((user) => user.id === this.selected) ? this.selected : this.users[0]?.id ?? null);
    } catch (error) {
      this.#fail(error);
    }
  }

  #enter(phase, problem = '') {
    this.phase = phase;
    this.problem = problem;
    this.emit('change');
  }

  #fail(error) {
    if (!(error instanceof ApiError)) throw error;
    if (error.code === LEFT) return;
    if (error.status === 401 || error.status === 403) {
      this.signOut(error.status === 401
        ? 'This key is not known, or it was revoked.'
        : 'The viewer needs a key with the scope admin: it lists people and changes versions.');
    } else {
      this.#enter('failed', error.message);
    }
  }

  // What is known.

  async #readUsers() {
    const [users, running, queued] = await Promise.all([
      this.api.users(), this.api.allJobs('running'), this.api.allJobs('queued'),
    ]);
    this.users = users;
    this.training = new Set([...running, ...queued].map((job) => job.user));
  }

  /** Look again; where nobody answers, say so and go on trying. */
  async refresh() {
    if (this.phase === 'failed') return this.load();
    if (this.phase !== 'ready' || this.#isRefreshing) return undefined;
    this.#isRefreshing = true;
    try {
      await this.#readUsers();
      this.#forgetGone();
      await this.#readDetails();
      this.isOnline = true;
    } catch (error) {
      if ([401, 403].includes(error.status) || !(error instanceof ApiError)) this.#fail(error);
      else if (error.code !== LEFT && error.status !== 404) this.isOnline = false;
    } finally {
      this.#isRefreshing = false;
    }
    this.emit('change');
    return undefined;
  }

  /** Somebody who was deleted elsewhere leaves the room. */
  #forgetGone() {
    if (this.users.length >= MOST_USERS) return; // who is not listed may be known all the same
    const known = new Set(this.users.map((user) => user.id));
    for (const id of [...this.performers.keys()]) if (!known.has(id)) this.stop(id);
    if (this.selected && !known.has(this.selected)) {
      this.toast(`${this.selected} is not known any more.`, true);
      Object.assign(this, { selected: this.users[0]?.id ?? null, details: null });
    }
  }

  /** @param {string | null} id */
  async select(id) {
    if (id !== this.selected) this.details = null;
    this.selected = id;
    this.emit('change');
    await this.#readDetails().catch((error) => this.#complain(error));
    this.emit('change');
  }

  async #readDetails() {
    const id = this.selected;
    if (!id) return;
    const [trials, versions, jobs] = await Promise.all([
      this.api.trials(id), this.api.versions(id), this.api.jobs(id),
    ]);
    if (id !== this.selected) return;
    this.details = { trials, versions, jobs };
    jobs.filter((job) => OPEN_STATES.has(job.state)).slice(0, WATCHED_MOST).forEach((job) => this.#watch(job));
  }

  #watch(job) {
    if (this.#watched.has(job.id)) return;
    for (const [id, oldest] of [...this.#watched].slice(0, Math.max(0, this.#watched.size + 1 - WATCHED_MOST))) {
      oldest.abort();
      this.#watched.delete(id);
    }
    const watch = new AbortController();
    this.#watched.set(job.id, watch);
    const told = (news) => {
      const jobs = this.details?.jobs;
      const place = jobs?.findIndex((one) => one.id === news.id) ?? -1;
      if (place >= 0) jobs[place] = news;
      this.emit('change');
      if (!OPEN_STATES.has(news.state)) this.#tellEnd(news);
    };
    this.api.watchJob(job.id, told, watch.signal)
      .catch(() => {}) // looked at again with the next refresh
      .finally(() => { if (this.#watched.get(job.id) === watch) this.#watched.delete(job.id); });
  }

  #tellEnd(job) {
    const text = { succeeded: `Version ${job.version} is trained.`, rejected: 'The new version did not win.', failed: 'Fine-tuning failed.' };
    if (text[job.state]) this.toast(text[job.state], job.state === 'failed'); // the job says more
    this.refresh();
  }

  // What can be done.

  /** Run something once at a time, and show what goes wrong. */
  async #act(name, act) {
    if (this.pending.has(name)) return undefined;
    this.pending.add(name);
    this.emit('change');
    try {
      return await act();
    } catch (error) {
      this.#complain(error);
      return undefined;
    } finally {
      this.pending.delete(name);
      await this.refresh();
    }
  }

  #complain(error) {
    if (error.code === LEFT) return;
    this.toast(error.message, true);
    if (!(error instanceof ApiError)) console.warn(error);
  }

  toast(text, isBad = false) { this.emit('toast', { text, bad: isBad }); }

  /** @throws {ApiError} */
  async addUser(user) {
    await this.api.addUser(user);
    await this.#readUsers();
    await this.select(user.id);
  }

  finetune() {
    return this.#act('finetune', () => this.api.finetune(this.selected));
  }

  cancelJob(id) { return this.#act('cancel', () => this.api.cancelJob(id)); }

  promote(number) {
    return this.#act('promote', async () => {
      await this.api.promote(this.selected, number, this.user.version.sha256);
      this.toast(number ? `Version ${number} answers from now on.` : 'The base answers from now on.');
    });
  }

  rollBack() {
    return this.#act('rollback', async () => {
      const active = await this.api.rollBack(this.selected, this.user.version.sha256);
      this.toast(active.number ? `Back to version ${active.number}.` : 'Back to the base.');
    });
  }

  setAutoPromote(isOn) {
    this.user.auto_promote = isOn; // shown at once; the answer may correct it
    return this.#act('auto', () => this.api.changeUser(this.selected, { auto_promote: isOn }));
  }

  record() {
    const when = new Date().toLocaleTimeString([], { hour: '2-digit', minute: '2-digit' });
    if (this.performer?.startTrial(`Viewer ${when}`) === false) {
      this.toast('Nothing is recorded: the stream is not open.', true);
    }
  }

  /** @param {boolean} finetune */
  stopRecording(finetune) { this.performer?.stopTrial(finetune); }

  /** Store the file that is being played as a trial, as it is. */
  uploadFile() {
    return this.#act('upload', async () => {
      await this.api.upload(this.selected, this.file, this.file.name);
      this.toast(`${this.file.name} is stored as a trial.`);
    });
  }

  // Who is in the room.

  /** Let some synthetic people come in, each under a name of their own. */
  async startDemo(count) {
    await this.#act('demo', async () => {
      const names = DEMO.slice(0, count);
      for (const [id, name] of names) {
        const known = this.users.find((user) => user.id === id);
        if (known && known.skeleton !== SKELETON) throw new ApiError(0, 'skeleton', `Synthetic people have the skeleton ${SKELETON}, ${id} has ${known.skeleton}.`);
        if (!known) await this.api.addUser({ id, display_name: name });
      }
      await this.#readUsers();
      this.stopAll();
      names.forEach(([id], i) => this.#perform(id, new SyntheticPerson(i + 1)));
      await this.select(names[0][0]);
    });
  }

  /** Let a synthetic person move as the selected one. */
  playSynthetic() {
    if (this.user.skeleton !== SKELETON) {
      this.toast(`Synthetic people have the skeleton ${SKELETON}, ${this.user.id} has ${this.user.skeleton}.`, true);
      return;
    }
    const demo = DEMO.findIndex(([id]) => id === this.selected) + 1;
    const number = demo || [...this.selected].reduce((sum, letter) => (31 * sum + letter.codePointAt(0)) % 997, 5);
    this.#files.delete(this.selected);
    this.#perform(this.selected, new SyntheticPerson(number));
  }

  /** Play a recording as the selected person, or as a new one where there is nobody. */
  playFile(file) {
    return this.#act('file', async () => {
      if (!this.selected) await this.addUser({ id: 'recording', display_name: 'From a recording' });
      const { user } = this;
      if (!user) throw new ApiError(0, 'nobody', 'Select the person of the recording first.');
      const { visit } = this.api;
      const skeleton = this.skeletons.find((one) => one.name === user.skeleton);
      const clips = await readRecording(file, skeleton);
      if (visit.aborted || !this.users.some((one) => one.id === user.id)) return;
      this.#files.set(user.id, file);
      this.#perform(user.id, new Player(file.name, clips, skeleton.name));
      const seconds = clips.reduce((sum, clip) => sum + clip.frames.length / clip.rateHz, 0);
      this.toast(`${file.name}: ${clips.length} ${clips.length === 1 ? 'clip' : 'clips'}, ${seconds.toFixed(1)} s.`);
    });
  }

  #perform(id, source) {
    const known = this.performers.get(id);
    if (known) {
      known.play(source);
    } else {
      const user = this.users.find((one) => one.id === id);
      const skeleton = this.skeletons.find((one) => one.name === user.skeleton);
      const performer = new Performer({ url: this.url, key: readKey, user, skeleton, source });
      performer.on('change', () => this.emit('change'));
      performer.on('recording', (message) => this.#hearRecording(message));
      performer.on('version', () => this.refresh());
      performer.on('job', () => this.#readDetails().catch(() => {}));
      performer.on('trouble', (message) => this.#hearTrouble(message));
      this.performers.set(id, performer);
      performer.start();
    }
    this.emit('figures');
    this.emit('change');
  }

  #hearRecording(message) {
    if (message?.state === 'stored') {
      this.toast(message.job ? 'Trial stored; fine-tuning has been asked for.' : 'Trial stored.');
      this.refresh();
    }
    this.emit('change');
  }

  /** Late frames show in the strip of latencies; other errors are said. */
  #hearTrouble({ code, message }) {
    const isNew = performance.now() - (this.#said.get(code) ?? -Infinity) > REPEAT_MS;
    if (code === 'stale_frame' || !isNew) return;
    this.#said.set(code, performance.now());
    this.toast(message, true);
  }

  stop(id = this.selected) {
    this.performers.get(id)?.stop();
    this.performers.delete(id);
    this.#files.delete(id);
    this.emit('figures');
    this.emit('change');
  }

  stopAll() {
    for (const id of [...this.performers.keys()]) this.stop(id);
  }
}
