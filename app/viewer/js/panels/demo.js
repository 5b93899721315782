import { h, replace } from '../dom.js';

/** Without a sensor: synthetic people, or a recording. */
export function showDemo(app, node) {
  const isReady = app.phase === 'ready';
  const isOn = app.performers.size > 0;
  const start = (count) => h('button', {
    class: 'button', type: 'button', 'data-key': `demo-${count}`, disabled: !isReady || app.pending.has('demo'),
    onclick: () => app.startDemo(count),
  }, count === 1 ? '1 person' : `${count} people`);
  const picker = h('input', {
    type: 'file', accept: '.mat,.npz,.csv', class: 'hidden', id: 'file', tabindex: '-1', 'aria-label': 'Recording',
    onchange: (event) => {
      if (event.target.files[0]) app.playFile(event.target.files[0]);
      event.target.value = '';
    },
  });
  replace(node,
    h('div', { class: 'card-head' }, h('h2', { id: 'demo-title' }, 'No sensor?'),
      isOn && h('button', { class: 'button small', type: 'button', 'data-key': 'demo-stop', onclick: () => app.stopAll() }, 'Stop all')),
    h('p', { class: 'muted' }, 'Synthetic people, through the real stream:'),
    h('div', { class: 'split' }, start(1), start(3)),
    h('div', { class: 'drop' },
      h('p', { class: 'muted' }, 'Or drop a recording here: UTD-MHAD .mat, .npz or .csv'),
      h('button', { class: 'button small', type: 'button', 'data-key': 'demo-file', disabled: !isReady, onclick: () => document.getElementById('file').click() }, 'Choose a file'),
      picker));
}
