import { byId, h, replace } from '../dom.js';

const LINKS = {
  open: ['Streaming', 'good'], connecting: ['Connecting', 'busy'], waiting: ['Reconnecting', 'warn busy'],
};

/** The bar at the top, and the line that says that something is wrong. */
export function showState(app) {
  const { performer, user } = app;
  byId('sign-out').hidden = app.phase !== 'ready' && app.phase !== 'failed';
  byId('layout').inert = app.phase === 'signed-out';
  byId('layout').setAttribute('aria-busy', String(app.phase === 'loading'));
  replace(byId('who'), ...(user ? [h('strong', {}, user.display_name ?? user.id), ` · ${user.skeleton}, ${user.up} up`] : []));
  const isLost = !app.isOnline || performer?.state === 'waiting';
  const [text, look] = isLost ? LINKS.waiting : (performer ? (LINKS[performer.state] ?? ['Stream closed', 'bad']) : ['Ready', 'good']);
  const link = byId('link');
  const said = app.phase === 'ready' ? text : '';
  if (link.textContent !== said) link.textContent = said;
  link.className = `chip ${look}`;
  const banner = byId('banner');
  const trouble = app.phase === 'ready' && findTrouble(app, isLost);
  banner.hidden = !trouble;
  if (trouble && banner.textContent !== trouble) banner.textContent = trouble;
}

function findTrouble(app, isLost) {
  if (isLost) return 'Connection lost. Trying again; the last 30 seconds stay here.';
  if (app.performer?.state === 'closed') return `The stream ended: ${app.performer.reason}`;
  return '';
}

/** What stands in the room while nobody is in it. */
export function showNotice(app, dialogs, node) {
  const notice = chooseNotice(app, dialogs);
  node.hidden = !notice;
  if (!notice) return replace(node);
  const mark = `${app.phase}|${app.problem}|${app.selected}|${app.pending.size}`;
  if (node.dataset.mark === mark && node.childElementCount) return undefined;
  node.dataset.mark = mark;
  return replace(node, ...notice);
}

function chooseNotice(app, dialogs) {
  if (app.phase === 'signed-out') return [h('h2', {}, 'Half a second ahead'), h('p', {}, 'Sign in with a key to see people and their forecasts.')];
  if (app.phase === 'loading') return [h('h2', {}, 'Loading'), h('p', {}, 'Asking the service who is known.')];
  if (app.phase === 'failed') return [
    h('h2', {}, 'The service does not answer'), h('p', {}, `It is asked again every few seconds. (${app.problem})`),
    h('button', { class: 'button primary', type: 'button', onclick: () => app.load() }, 'Try again'),
  ];
  if (app.performers.size) return null;
  const demo = h('button', {
    class: 'button primary', type: 'button', disabled: app.pending.has('demo'), onclick: () => app.startDemo(3),
  }, 'Watch three synthetic people');
  if (!app.users.length) return [
    h('h2', {}, 'Nobody here yet'),
    h('p', {}, 'Kinecast forecasts how a person will move in the next half second. No sensor is needed to see it.'),
    h('div', { class: 'row' }, demo, h('button', { class: 'button', type: 'button', onclick: () => dialogs.openAdd() }, 'Add a person')),
  ];
  return [
    h('h2', {}, 'Nobody is moving'),
    h('p', {}, 'Start the demo, let a synthetic person play the one who is selected, or drop a recording anywhere on this page.'),
    h('div', { class: 'row' }, demo,
      app.user && h('button', { class: 'button', type: 'button', onclick: () => app.playSynthetic() }, `Play as ${app.user.display_name ?? app.user.id}`)),
  ];
}
