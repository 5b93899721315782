import { h, icon, replace } from '../dom.js';
import { now } from '../stream.js';
import { showJobs } from './jobs.js';
import { showVersions } from './versions.js';

/** Everything about the person who is selected. */
export function showDetail(app, node) {
  const { user } = app;
  if (!user) {
    replace(node, h('section', { class: 'card' }, h('h2', {}, 'Person'),
      app.phase === 'loading' ? h('div', { class: 'skeleton-line' }) : h('p', { class: 'muted' }, 'Whoever is selected shows up here, with recordings and versions.')));
    return;
  }
  replace(node, showActions(app, user), showJobs(app), showVersions(app), showTrials(app));
}

function showActions(app, user) {
  const { performer, details } = app;
  const canTrain = details?.trials.some((trial) => trial.state === 'stored');
  return h('section', { class: 'card' },
    h('div', { class: 'card-head' }, h('h2', {}, user.display_name ?? user.id),
      h('span', { class: `chip plain ${user.version.kind === 'personal' ? 'personal' : 'base'}` },
        user.version.kind === 'personal' ? `version ${user.version.number}` : 'base')),
    showSource(app, performer),
    showRecorder(app, performer),
    h('div', { class: 'split' },
      h('button', {
        class: 'button', type: 'button', 'data-key': 'finetune', id: 'finetune', disabled: !canTrain || app.pending.has('finetune'),
        title: canTrain ? 'Train on all stored trials' : 'Record a trial first', onclick: () => app.finetune(),
      }, 'Fine-tune'),
      h('button', {
        class: 'button', type: 'button', 'data-key': 'rollback', id: 'rollback',
        disabled: user.version.kind !== 'personal' || app.pending.has('rollback'),
        title: 'Back to what was active before', onclick: () => app.rollBack(),
      }, 'Roll back')),
    h('label', { class: 'check' }, h('input', {
      type: 'checkbox', 'data-key': 'auto', id: 'auto', checked: user.auto_promote, onchange: (event) => app.setAutoPromote(event.target.checked),
    }), 'Versions that win become active'));
}

function showSource(app, performer) {
  if (!performer) {
    return h('button', { class: 'button', type: 'button', 'data-key': 'play', id: 'play', onclick: () => app.playSynthetic() }, 'Play a synthetic person');
  }
  return h('div', { class: 'row' }, h('span', { class: 'muted' }, performer.source.name),
    app.file && h('button', { class: 'button small', type: 'button', 'data-key': 'upload', disabled: app.pending.has('upload'), onclick: () => app.uploadFile() }, 'Store as a trial'),
    h('button', { class: 'button small', type: 'button', 'data-key': 'stop', id: 'stop', onclick: () => app.stop() }, 'Stop'));
}

let asksToTrain = true;

function showRecorder(app, performer) {
  const recording = performer?.recording;
  if (recording) {
    const seconds = Math.max(0, now() - recording.since).toFixed(0);
    return h('div', { class: 'jobs' },
      h('div', { class: 'split' },
        h('button', { class: 'button recording', type: 'button', 'data-key': 'record', id: 'record', disabled: recording.state === 'storing', onclick: () => app.stopRecording(asksToTrain) }, icon('stop'), 'Stop and store'),
        h('button', { class: 'button', type: 'button', 'data-key': 'discard', id: 'discard', onclick: () => performer.cancelTrial() }, 'Discard')),
      h('p', { class: 'muted' }, recording.state === 'storing' ? 'Storing…' : `Recording, ${seconds} s. Half a minute of different motion is a good start.`));
  }
  return h('div', { class: 'jobs' },
    h('button', {
      class: 'button primary', type: 'button', 'data-key': 'record', id: 'record', disabled: performer?.state !== 'open',
      title: performer ? 'Record what is streamed (R)' : 'Nobody is moving', onclick: () => app.record(),
    }, icon('record'), 'Record a trial'),
    h('label', { class: 'check' }, h('input', {
      type: 'checkbox', 'data-key': 'train-after', checked: asksToTrain, onchange: (event) => { asksToTrain = event.target.checked; },
    }), 'Fine-tune after it'));
}

function showTrials(app) {
  const trials = app.details?.trials;
  return h('section', { class: 'card', 'aria-labelledby': 'trials-title' },
    h('h2', { id: 'trials-title' }, 'Trials'),
    !trials ? h('div', { class: 'skeleton-line' })
      : !trials.length ? h('p', { class: 'muted' }, 'None yet. A trial is a recording that versions learn from.')
        : h('ul', { class: 'trials' }, trials.map((trial) => h('li', { class: 'trial' },
          h('strong', {}, trial.label ?? 'Trial'),
          h('span', { class: `chip plain ${trial.state === 'recording' ? 'bad' : ''}` }, trial.state),
          h('span', { class: 'muted' }, `${trial.seconds.toFixed(0)} s, ${trial.clips} ${trial.clips === 1 ? 'clip' : 'clips'}${trial.clips_unused ? `, ${trial.clips_unused} not used` : ''}`),
          h('time', { class: 'muted', datetime: trial.created_at }, showTime(trial.created_at))))));
}

export function showTime(instant) {
  const at = new Date(instant);
  const isToday = at.toDateString() === new Date().toDateString();
  return isToday ? at.toLocaleTimeString([], { hour: '2-digit', minute: '2-digit' }) : at.toLocaleDateString([], { day: 'numeric', month: 'short' });
}
