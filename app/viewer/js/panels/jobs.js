import { h } from '../dom.js';

const LOOKS = {
  queued: 'busy', running: 'personal busy', succeeded: 'good', rejected: 'warn', failed: 'bad', cancelled: '',
};
const PHASES = { training: 'Fitting', judging: 'Judging' };
const SHOWN = 3;

/** The newest jobs, with how far they are. */
export function showJobs(app) {
  const jobs = app.details?.jobs ?? [];
  if (!jobs.length) return null;
  return h('section', { class: 'card', 'aria-labelledby': 'jobs-title' },
    h('h2', { id: 'jobs-title' }, 'Fine-tuning'),
    h('ul', { class: 'jobs' }, jobs.slice(0, SHOWN).map((job) => showJob(app, job))));
}

function showJob(app, job) {
  const isOpen = job.state === 'queued' || job.state === 'running';
  return h('li', { class: 'job', 'data-job': job.id },
    h('div', { class: 'card-head' },
      h('span', { class: `chip ${LOOKS[job.state]}` }, job.state),
      isOpen && h('button', { class: 'button small', type: 'button', 'data-key': `cancel-${job.id}`, onclick: () => app.cancelJob(job.id) }, 'Cancel')),
    isOpen && showProgress(job),
    h('p', { class: 'muted' }, describe(job)));
}

function showProgress({ state, progress }) {
  const attributes = { 'aria-label': 'Progress', max: progress?.steps ?? 1 };
  if (state === 'running' && progress?.steps) attributes.value = progress.step;
  return h('progress', attributes);
}

function describe({ state, message, progress, version }) {
  if (state === 'queued') return 'Waits for a worker.';
  if (state === 'running') {
    const what = PHASES[progress?.phase] ?? 'Getting ready';
    const left = progress?.seconds_left;
    return left === undefined || left === null ? `${what}…` : `${what}, about ${Math.ceil(left)} s left`;
  }
  return `${version ? `Version ${version}. ` : ''}${message ?? ''}`;
}
