import { byId, h, replace, svg } from '../dom.js';

const VIEWS = [['corner', 'Corner'], ['sensor', 'Sensor'], ['side', 'Side'], ['top', 'Above']];
const EVERY_MS = 250;

/** What the colours and shapes in the room mean, the camera, and what is said of this moment. */
export class Legend {
  #last = 0;

  constructor(view) {
    this.view = view;
    this.said = '';
    replace(byId('views'), h('div', { class: 'segment' }, VIEWS.map(([name, text], i) => h('button', {
      class: 'button small', type: 'button', title: `Camera ${i + 1} (${i + 1})`, onclick: () => view.stage.look(name),
    }, text))));
  }

  show() {
    const { app, show } = this.view;
    const isPersonal = app.performer?.isPersonal;
    const rows = app.performers.size ? [
      [line('--truth', 5), 'now'],
      isPersonal && [ghosts('--personal'), 'forecast, personal'],
      (show.base || !isPersonal) && [ghosts('--base'), isPersonal ? 'forecast, base' : 'forecast by the base'],
      show.tubes && [tube(isPersonal ? '--personal' : '--base'), '90 % of joints, in 0.2 s'],
      show.echo && [echo(isPersonal ? '--personal' : '--base'), 'forecast 0.5 s ago for now'],
    ].filter(Boolean) : [];
    const mark = JSON.stringify(rows.map(([, text]) => text)) + isPersonal;
    if (mark === this.mark) return;
    this.mark = mark;
    replace(byId('legend'), rows.map(([shape, text]) => h('li', {}, shape, text)));
  }

  /** A few times a second. */
  follow() {
    if (performance.now() - this.#last < EVERY_MS) return;
    this.#last = performance.now();
    const { app } = this.view;
    const chips = app.performer ? describe(app.performer, this.view.momentOf(app.selected)) : [];
    const said = JSON.stringify(chips);
    if (said === this.said) return;
    this.said = said;
    replace(byId('readout'), chips.map(([text, look]) => h('span', { class: `chip plain ${look ?? ''}` }, text)));
  }
}

function describe(performer, moment) {
  const forecast = moment?.personal ?? moment?.base;
  if (!forecast) return [[performer.waiting ? `waiting: ${performer.waiting.replace('_', ' ')}` : 'no forecast', 'warn']];
  const { version, severity, quality } = forecast;
  return [
    version.kind === 'personal'
      ? [`version ${version.number} · ${Math.round(100 * version.share)} % personal`, 'personal']
      : [version.kind.replace('_', ' '), 'base'],
    moment.action && [moment.action],
    ...quality.filter((flag) => flag !== 'blended').map((flag) => [flag.replaceAll('_', ' '), severity === 'info' ? '' : 'bad']),
  ].filter(Boolean);
}

const picture = (...shapes) => svg('svg', { viewBox: '0 0 26 12', 'aria-hidden': 'true' }, ...shapes);
const stroke = (colour, more) => ({ stroke: `var(${colour})`, fill: 'none', 'stroke-linecap': 'round', ...more });

export function line(colour, width, dash) {
  return picture(svg('path', stroke(colour, { d: 'M3 6H23', 'stroke-width': width, 'stroke-dasharray': dash })));
}

function ghosts(colour) {
  return picture(...[0.25, 0.5, 0.75, 1].map((opacity, i) => svg('path', stroke(colour, { d: `M${4 + 6 * i} 10L${6 + 6 * i} 2`, 'stroke-width': 2.4, opacity }))));
}

function tube(colour) {
  return picture(svg('rect', { x: 2, y: 1, width: 22, height: 10, rx: 5, fill: `var(${colour})`, opacity: 0.3 }),
    svg('rect', stroke(colour, { x: 2, y: 1, width: 22, height: 10, rx: 5, 'stroke-width': 1 })));
}

function echo(colour) {
  return picture(svg('path', stroke(colour, { d: 'M4 6H22', 'stroke-width': 1.4 })),
    ...[4, 13, 22].map((x) => svg('circle', { cx: x, cy: 6, r: 2.4, fill: `var(${colour})` })));
}
