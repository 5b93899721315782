import { Emitter } from './emitter.js';
import { HORIZONS, isAhead } from './metrics.js';
import { FPS, HISTORY_S } from './performer.js';
import { Figure } from './scene/figure.js';
import { readPalette } from './scene/palette.js';

const APART_M = 1.45;
const HALF_SECOND = 15;
/** How far back the newest frame with a forecast may be to be shown as now. */
const BEHIND = 12;
/** Several people's frames do not come at once: what comes within this time of a picture waits for the next. */
const LEAST_MS = 25;

/** What is looked at: which moment, with what, and how often it is drawn. Tells `change`. */
export class View extends Emitter {
  #frozen = null;
  #last = 0;
  #held = new Map();
  #shown = '';

  /**
   * @param {import('./app.js').App} app
   * @param {import('./scene/stage.js').Stage} stage
   */
  constructor(app, stage) {
    super();
    this.app = app;
    this.stage = stage;
    /** @type {Map<string, Figure>} */
    this.figures = new Map();
    this.show = { base: true, personal: true, beside: false, tubes: true, echo: true, hold: false };
    /** Frames back from the newest, while paused. */
    this.back = 0;
    this.horizon = HORIZONS[1];
    this.drawn = 0;
    this.palette = readPalette();
    stage.paint(this.palette);
  }

  get isPaused() { return this.#frozen !== null; }

  /** Newest frame that can be looked back on, per person, as it was when paused. */
  momentsOf(id) {
    if (this.#frozen) return this.#frozen.get(id) ?? [];
    return this.app.performers.get(id)?.history.toArray() ?? [];
  }

  /** @returns {import('./performer.js').Moment | undefined} what is shown of a person */
  momentOf(id, before = 0) {
    if (this.#frozen) {
      const moments = this.#frozen.get(id) ?? [];
      const back = Math.min(Math.round(this.back), moments.length - 1); // others may have fewer
      return moments[moments.length - 1 - back - before];
    }
    const history = this.app.performers.get(id)?.history;
    return history?.get(this.#findNow(id, history) - before);
  }

  /** The newest frame that has been answered, by both where there are two; the newest of all where none has. */
  #findNow(id, history) {
    const isPersonal = this.app.performers.get(id)?.isPersonal;
    let answered = history.next - 1;
    for (let number = history.next - 1; number >= history.next - BEHIND; number--) {
      const moment = history.get(number);
      if (!moment?.personal) continue;
      if (!isPersonal || moment.base) return number;
      if (!history.get(answered)?.personal) answered = number;
    }
    return answered;
  }

  /** Stop the picture; the stream goes on, as a robot's would. */
  pause() {
    if (!this.app.performers.size) return;
    this.#frozen = new Map([...this.app.performers].map(([id, one]) => [id, one.history.toArray()]));
    const history = this.app.performer?.history;
    this.back = history ? history.next - 1 - this.#findNow(this.app.selected, history) : 0;
    this.emit('change');
  }

  resume() {
    this.#frozen = null;
    this.back = 0;
    this.emit('change');
  }

  toggle() {
    if (this.isPaused) this.resume();
    else this.pause();
  }

  /** @param {number} frames back from the newest */
  seek(frames) {
    if (!this.isPaused) this.pause();
    this.back = Math.min(this.reach, Math.max(0, frames));
    this.emit('change');
  }

  /** How many frames there are to go back. */
  get reach() {
    return Math.max(0, Math.min(HISTORY_S * FPS, this.momentsOf(this.app.selected).length) - 1);
  }

  /** @param {string} name */
  flip(name) {
    this.show[name] = !this.show[name];
    this.#held.clear();
    this.emit('change');
  }

  setHorizon(frames) {
    this.horizon = frames;
    this.emit('change');
  }

  /** Give everybody in the room a figure and a place. */
  meet() {
    for (const [id, figure] of this.figures) {
      if (!this.app.performers.has(id)) {
        figure.dispose();
        this.figures.delete(id);
      }
    }
    for (const [id, performer] of this.app.performers) {
      if (!this.figures.has(id)) {
        const figure = new Figure(performer.skeleton);
        figure.paint(this.palette);
        this.figures.set(id, figure);
        this.stage.scene.add(figure.group);
      }
      this.figures.get(id).settle();
    }
    const people = this.figures.size;
    [...this.figures.values()].forEach((figure, i) => {
      figure.group.position.x = ((people - 1) / 2 - i) * APART_M;
    });
    if (this.isPaused) this.resume();
    this.stage.frame(people);
  }

  paint() {
    this.palette = readPalette();
    this.stage.paint(this.palette);
    for (const figure of this.figures.values()) figure.paint(this.palette);
    this.touch();
  }

  /** Draw whenever there is something new to see, as often as the screen allows. */
  run(also) {
    const draw = (time) => {
      requestAnimationFrame(draw);
      also();
      if (!this.#isNew(time)) return;
      for (const [id, figure] of this.figures) this.#pose(id, figure);
      this.stage.draw(time - this.#last);
      this.#last = time;
      this.drawn += 1;
    };
    requestAnimationFrame(draw);
  }

  /** Draw once more, although nobody moved. */
  touch() { this.#shown = ''; }

  #isNew(time) {
    const hasMoved = this.stage.hasMoved();
    if (!hasMoved && time - this.#last < LEAST_MS) return false;
    const seen = [...this.figures.keys()].map((id) => this.momentOf(id)?.seq ?? -1);
    const mark = `${seen}|${JSON.stringify(this.show)}|${this.app.selected}|${this.back}`;
    const isNew = mark !== this.#shown || hasMoved;
    this.#shown = mark;
    return isNew;
  }

  #pose(id, figure) {
    const moment = this.momentOf(id);
    if (!moment) return;
    const { show } = this;
    figure.set(moment, this.#hold(id, moment), this.#past(id, moment), {
      ...show,
      up: this.app.performers.get(id)?.user.up ?? 'y',
      base: show.base && (id === this.app.selected || !this.app.performers.get(id)?.isPersonal),
    });
  }

  /** The moment half a second before; none where the page was held up in between. */
  #past(id, moment) {
    const past = this.momentOf(id, HALF_SECOND);
    return past && isAhead(moment.t, past.t, HALF_SECOND) ? past : undefined;
  }

  /** Let a forecast stand for half a second, so that the person walks into it. */
  #hold(id, moment) {
    if (!this.show.hold) return moment;
    const held = this.#held.get(id);
    const age = held ? moment.seq - held.seq : Infinity;
    if (age >= 0 && age <= HALF_SECOND && (held.personal || held.base)) return held;
    this.#held.set(id, moment);
    return moment;
  }
}
