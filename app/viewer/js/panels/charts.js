import { StripChart } from '../chart.js';
import { byId, h, replace } from '../dom.js';
import { HORIZONS, mean, quantile, smooth } from '../metrics.js';
import { DEADLINE_MS, FPS, HISTORY_S } from '../performer.js';
import { readPalette } from '../scene/palette.js';
import { line } from './legend.js';

const EVERY_MS = 200;
/** Frames over which the lines are smoothed: half a second. */
const WIDTH = 15;

/** The strips below the room: errors as the truth arrives, and how long forecasts took. */
export class ChartPanel {
  #last = 0;
  #marks = {};

  constructor(app, view) {
    this.app = app;
    this.view = view;
    this.errors = new StripChart(byId('error-chart'), { seconds: HISTORY_S, unit: 'mm', least: 100 });
    this.latency = new StripChart(byId('latency-chart'), { seconds: HISTORY_S, unit: 'ms', least: 40 });
    this.paint();
    this.follow();
  }

  paint() {
    this.palette = readPalette();
    this.#last = 0;
  }

  follow() {
    if (performance.now() - this.#last < EVERY_MS) return;
    this.#last = performance.now();
    const moments = this.view.momentsOf(this.app.selected);
    const at = this.view.isPaused ? this.view.back / FPS : null;
    this.#showErrors(moments, at);
    this.#showLatency(moments, at);
  }

  #showErrors(moments, at) {
    const k = HORIZONS.indexOf(this.view.horizon);
    const values = (name) => moments.map((moment) => moment.errors[k][name]);
    const isPersonal = moments.some((moment) => moment.personal && moment.personal !== moment.base);
    const rows = [
      { name: 'zero', text: 'Zero velocity', dash: [2, 3], svgDash: '1 4', width: 1.5, values: values('zero') },
      { name: 'base', text: 'Base', dash: [7, 3], svgDash: '6 4', width: 1.8, values: values('base') },
      isPersonal && { name: 'personal', text: 'Personal', dash: [], svgDash: null, width: 2.2, values: personalOnly(moments, k) },
    ].filter(Boolean);
    this.errors.draw(this.palette, rows.map((row) => ({
      ...row, colour: this.palette[row.name], values: smooth(row.values, WIDTH),
    })), { at });
    const said = rows.map((row) => ({ ...row, value: show(mean(row.values), 'mm') }));
    this.#caption('error', said.map(({ text, value }) => `${text} ${value}`).join(', ') + this.view.horizon, () => [
      h('strong', {}, 'Error'),
      ...said.map(({ name, text, value, svgDash }) => h('span', {}, line(`--${name}`, 2.4, svgDash), `${text} `, h('strong', {}, value))),
      this.#horizons(),
    ]);
    byId('error-chart').setAttribute('aria-label', `Mean error of the last 30 seconds. ${said.map(({ text, value }) => `${text} ${value}`).join(', ')}`);
  }

  #horizons() {
    return h('span', { class: 'segment', role: 'group', 'aria-label': 'How far ahead' }, HORIZONS.map((frames) => h('button', {
      class: 'button small', type: 'button', 'data-key': `horizon-${frames}`, 'aria-pressed': String(frames === this.view.horizon),
      onclick: () => { this.view.setHorizon(frames); this.#last = 0; },
      'aria-label': `${Math.round((1000 * frames) / FPS)} ms ahead`,
    }, `${Math.round((1000 * frames) / FPS)}${frames === HORIZONS.at(-1) ? ' ms' : ''}`)));
  }

  #showLatency(moments, at) {
    const values = moments.map((moment) => moment.latencyMs);
    const missed = values.filter((value) => value > DEADLINE_MS).length;
    this.latency.draw(this.palette, [
      { name: 'latency', colour: this.palette.ink, values, dash: [], width: 1.4, marks: (value) => value > DEADLINE_MS },
    ], { at, limit: DEADLINE_MS });
    const facts = { middle: show(quantile(values, 0.5), 'ms'), tail: show(quantile(values, 0.99), 'ms'), missed };
    this.#caption('latency', JSON.stringify(facts), () => [
      h('strong', {}, 'Latency'),
      h('span', {}, 'p50 ', h('strong', {}, facts.middle)), h('span', {}, 'p99 ', h('strong', {}, facts.tail)),
      h('span', { title: 'Forecasts that took longer than one frame, 33 ms' }, '× late ', h('strong', {}, String(missed))),
    ]);
    byId('latency-chart').setAttribute('aria-label', `Latency: median ${facts.middle}, p99 ${facts.tail}, ${missed} forecasts later than one frame`);
  }

  #caption(name, mark, make) {
    if (this.#marks[name] === mark) return;
    this.#marks[name] = mark;
    replace(byId(`${name}-caption`), make());
  }
}

/** The personal line where a personal version answered; before it there is only the base. */
function personalOnly(moments, k) {
  return moments.map((moment, i) => {
    const said = moments[i - HORIZONS[k]];
    return said?.personal && said.personal !== said.base ? moment.errors[k].personal : NaN;
  });
}

function show(value, unit) {
  return Number.isFinite(value) ? `${value < 10 ? value.toFixed(1) : Math.round(value)} ${unit}` : '–';
}
