import { h, icon, replace } from '../dom.js';
import { FPS } from '../performer.js';

const TOGGLES = [
  ['beside', 'Side by side', 'Show the forecast of the base beside the personal one (B)'],
  ['tubes', 'Radius', 'Show where the joints are with a probability of 90 % (V)'],
  ['echo', 'Check', 'Show what was forecast for now half a second ago (E)'],
  ['hold', 'Hold', 'Let each forecast stand for half a second, so that the person walks into it (H)'],
];

/** Pause, the slider over the last half minute, and what is shown. */
export class Transport {
  constructor(view, node) {
    this.view = view;
    this.pause = h('button', { class: 'button icon-only', type: 'button', id: 'pause', onclick: () => view.toggle() });
    this.slider = h('input', {
      type: 'range', id: 'scrub', min: 0, max: 0, step: 1, 'aria-label': 'The last 30 seconds',
      oninput: () => view.seek(Number(this.slider.max) - Number(this.slider.value)),
    });
    this.time = h('output', { class: 'time', for: 'scrub' }, 'now');
    this.live = h('button', { class: 'button small', type: 'button', id: 'live', onclick: () => view.resume() }, 'Live');
    this.toggles = TOGGLES.map(([name, text, title]) => h('button', {
      class: 'button small', type: 'button', id: `show-${name}`, title, onclick: () => view.flip(name),
    }, text));
    replace(node, this.pause, h('div', { class: 'scrub grow' }, this.slider), this.time, this.live,
      h('div', { class: 'toggles', role: 'group', 'aria-label': 'What is shown' }, this.toggles));
    this.show();
  }

  /** After a click or a key. */
  show() {
    const { view } = this;
    const isOn = view.app.performers.size > 0;
    const text = view.isPaused ? 'Go on' : 'Pause';
    if (this.pause.title !== `${text} (Space)`) {
      this.pause.title = `${text} (Space)`;
      this.pause.setAttribute('aria-label', text);
      this.pause.replaceChildren(icon(view.isPaused ? 'play' : 'pause'));
    }
    this.pause.disabled = !isOn;
    this.slider.disabled = !isOn;
    this.live.disabled = !view.isPaused;
    TOGGLES.forEach(([name], i) => this.toggles[i].setAttribute('aria-pressed', String(view.show[name])));
    this.follow();
  }

  /** With every picture. */
  follow() {
    const reach = Math.max(0, this.view.reach);
    if (Number(this.slider.max) !== reach) this.slider.max = reach;
    const value = reach - Math.round(this.view.back);
    if (document.activeElement !== this.slider || !this.view.isPaused) this.slider.value = value;
    const back = this.view.isPaused ? this.view.back / FPS : 0;
    const text = this.view.isPaused ? `−${back.toFixed(1)} s` : 'now';
    if (this.time.textContent !== text) {
      this.time.textContent = text;
      this.slider.setAttribute('aria-valuetext', this.view.isPaused ? `${back.toFixed(1)} seconds ago` : 'now');
    }
  }
}
