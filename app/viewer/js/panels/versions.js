import { h, svg } from '../dom.js';
import { showTime } from './detail.js';

const ROW = 56;
const LANE = 14;
const FIRST = 10;
const LOOKS = { active: 'good', candidate: 'warn', retired: '', rejected: 'bad' };

/** The versions of a person and what came out of what: the line of the active one on the left. */
export function showVersions(app) {
  const versions = app.details?.versions;
  const { user } = app;
  const title = h('h2', { id: 'versions-title' }, 'Versions');
  if (!versions) return h('section', { class: 'card' }, title, h('div', { class: 'skeleton-line' }));
  const base = { number: 0, parent: null, state: user.version.kind === 'base' ? 'active' : 'retired', metrics: {} };
  const rows = [...versions, base];
  return h('section', { class: 'card', 'aria-labelledby': 'versions-title' }, title,
    h('ol', { class: 'lineage' }, drawTree(rows, user.version.number ?? 0), rows.map((version) => showVersion(app, version))));
}

function showVersion(app, version) {
  const { number, state, purged } = version;
  const isActive = number === (app.user.version.number ?? 0);
  return h('li', { class: 'version', 'data-version': number },
    h('span', { 'aria-hidden': 'true' }),
    h('span', { class: 'name' }, number ? `Version ${number}` : 'Base',
      (number > 0 || isActive) && h('span', { class: `chip plain ${isActive ? 'good' : LOOKS[state]}` }, isActive ? 'active' : state)),
    !isActive && !purged && h('button', {
      class: 'button small', type: 'button', 'data-key': `promote-${number}`, disabled: app.pending.has('promote'),
      'aria-label': number ? `Promote version ${number}` : 'Promote the base', onclick: () => app.promote(number),
    }, 'Promote'),
    h('span', { class: 'muted', title: number ? `Child of ${version.parent || 'the base'}, made ${version.created_at}` : '' },
      number ? `${describe(version)} · ${showTime(version.created_at)}` : 'the same for everybody'));
}

/** How much smaller the error became on motion like that recorded. */
function describe({ metrics, parent }) {
  const seen = metrics?.seen;
  const before = seen?.before_cm2?.at?.(-1);
  const after = seen?.after_cm2?.at?.(-1);
  const from = parent ? `from ${parent}` : 'from base';
  if (!(before > 0) || !(after >= 0)) return from;
  const change = Math.round(100 * (after / before - 1));
  return `${change > 0 ? '+' : '−'}${Math.abs(change)} % error, ${from}`;
}

/** Dots joined to their parents; who leads to the active one stands in the first lane. */
function drawTree(rows, active) {
  const at = new Map(rows.map((row, i) => [row.number, i]));
  const line = new Set();
  for (let n = active; at.has(n) && !line.has(n); n = rows[at.get(n)].parent) line.add(n);
  const x = (number) => FIRST + (line.has(number) ? 0 : LANE);
  const y = (number) => ROW * at.get(number) + ROW / 2;
  const joins = rows.filter((row) => row.parent !== null && at.has(row.parent)).map(({ number, parent }) => svg('path', {
    d: `M${x(number)} ${y(number)}V${y(parent) - 14}Q${x(number)} ${y(parent)} ${x(parent)} ${y(parent)}`,
  }));
  const dots = rows.map(({ number, state }) => (number === 0
    ? svg('rect', { x: x(0) - 5, y: y(0) - 5, width: 10, height: 10, rx: 2, class: number === active ? 'active' : '' })
    : svg('circle', { cx: x(number), cy: y(number), r: 5.5, class: number === active ? 'active' : state })));
  return svg('svg', { class: 'tree', width: 30, height: ROW * rows.length, 'aria-hidden': 'true' }, joins, dots);
}
