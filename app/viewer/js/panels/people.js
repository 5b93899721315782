import { MOST_USERS } from '../api.js';
import { h, replace } from '../dom.js';

/** The list of people with their state. */
export function showPeople(app, node) {
  if (app.phase === 'loading') {
    replace(node, h('div', { class: 'skeleton-line' }), h('div', { class: 'skeleton-line' }));
    return;
  }
  if (!app.users.length) {
    replace(node, h('p', { class: 'muted' }, app.phase === 'ready' ? 'No one is known yet.' : '—'));
    return;
  }
  replace(node,
    h('ul', { class: 'people' }, app.users.map((user) => h('li', {}, showPerson(app, user)))),
    app.users.length >= MOST_USERS && h('p', { class: 'muted' }, `These are the newest ${app.users.length}.`));
}

function showPerson(app, user) {
  const name = user.display_name ?? user.id;
  return h('button', {
    class: 'person', type: 'button', 'data-key': `person-${user.id}`, 'data-user': user.id,
    'aria-current': String(user.id === app.selected), onclick: () => app.select(user.id),
  },
  h('span', { class: 'face', 'aria-hidden': 'true' }, [...name][0].toUpperCase()),
  h('strong', {}, name),
  h('span', { class: 'chips' }, listStates(app, user).map(([text, look]) => h('span', { class: `chip ${look}` }, text))));
}

/** What can be said of somebody at a glance. */
export function listStates(app, user) {
  const performer = app.performers.get(user.id);
  const states = [user.version.kind === 'personal'
    ? [`v${user.version.number}`, 'personal plain'] : ['base', 'base plain']];
  if (performer?.recording) states.push(['recording', 'bad busy']);
  else if (performer?.state === 'open') states.push(['live', 'good']);
  else if (performer) states.push(['reconnecting', 'warn busy']);
  if (app.training.has(user.id)) states.push(['training', 'busy']);
  return states;
}
