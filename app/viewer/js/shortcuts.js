import { FPS } from './performer.js';

/** Every key, as the help shows it. */
export const SHORTCUTS = [
  ['Space', 'Pause, or go on'],
  ['← →', 'One frame back or on, with Shift one second'],
  ['D', 'Start or stop the demo'],
  ['R', 'Record a trial, or stop and store it'],
  ['H', 'Hold each forecast for half a second'],
  ['B', 'Base beside personal'],
  ['V', 'Radius on or off'],
  ['E', 'What was forecast for now, on or off'],
  ['1 2 3 4', 'Camera: from the corner, sensor, side, above'],
  ['[ ]', 'The person before or after in the list'],
  ['A', 'Add a person'],
  ['T', 'Theme'],
  ['?', 'This help'],
];
const VIEWS = { 1: 'corner', 2: 'sensor', 3: 'side', 4: 'top' };

/** @param {{app: any, view: any, stage: any, dialogs: any, theme: any}} parts */
export function listenToKeys({ app, view, stage, dialogs, theme }) {
  const step = (sign, event) => view.seek(view.back + sign * (event.shiftKey ? FPS : 1));
  const choose = (by) => {
    const at = app.users.findIndex((user) => user.id === app.selected);
    const next = app.users[at + by];
    if (next) app.select(next.id);
  };
  const keys = {
    ' ': () => view.toggle(),
    ArrowLeft: (event) => step(1, event),
    ArrowRight: (event) => step(-1, event),
    '[': () => choose(-1),
    ']': () => choose(1),
    d: () => (app.performers.size ? app.stopAll() : app.startDemo(3)),
    r: () => toggleRecording(app),
    h: () => view.flip('hold'),
    b: () => view.flip('beside'),
    v: () => view.flip('tubes'),
    e: () => view.flip('echo'),
    a: () => dialogs.openAdd(),
    t: () => theme.next(),
    '?': () => dialogs.openHelp(),
  };
  document.addEventListener('keydown', (event) => {
    const isTyping = event.target.closest?.('input, select, textarea, dialog[open]');
    if (isTyping || event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    if (event.key === ' ' && event.target.closest?.('button, a')) return;
    if (app.phase !== 'ready' && !['t', '?'].includes(event.key)) return;
    const act = VIEWS[event.key] ? () => stage.look(VIEWS[event.key]) : keys[event.key.length === 1 ? event.key.toLowerCase() : event.key];
    if (!act) return;
    event.preventDefault();
    act(event);
  });
}

export function toggleRecording(app) {
  if (!app.performer || app.performer.recording?.state === 'storing') return;
  if (app.performer.recording) app.stopRecording(true);
  else app.record();
}
