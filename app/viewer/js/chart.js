/** A strip of lines over the last seconds, on a canvas. */

const LEFT = 34;
const BOTTOM = 16;
const FPS = 30;

/** @typedef {{colour: string, values: number[], dash: number[], width: number,
 *   marks?: (value: number) => boolean}} Line values one per frame, the newest last, NaN for none */

export class StripChart {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{seconds: number, unit: string, least: number}} options least: lowest top of the scale
   */
  constructor(canvas, { seconds, unit, least }) {
    this.canvas = canvas;
    this.context = canvas.getContext('2d');
    this.seconds = seconds;
    this.unit = unit;
    this.least = least;
    this.top = least;
  }

  /**
   * @param {Record<string, string>} palette
   * @param {Line[]} lines
   * @param {{at?: number | null, limit?: number}} marks at: seconds back that are looked at
   */
  draw(palette, lines, { at = null, limit } = {}) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    const ratio = devicePixelRatio;
    if (this.canvas.width !== Math.round(width * ratio) || this.canvas.height !== Math.round(height * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(height * ratio);
    }
    const { context } = this;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    this.#scale(lines);
    const plot = { left: LEFT, right: width - 2, top: 4, bottom: height - BOTTOM };
    const x = (back) => plot.right - (back / this.seconds) * (plot.right - plot.left);
    const y = (value) => plot.bottom - (Math.min(value, this.top) / this.top) * (plot.bottom - plot.top);
    this.#drawAxes(palette, plot, x, y);
    if (limit) this.#drawRule(palette.miss, plot, y(limit));
    for (const line of lines) this.#drawLine(line, x, y, palette);
    if (at !== null) {
      context.strokeStyle = palette.ink;
      context.lineWidth = 1;
      context.setLineDash([]);
      stroke(context, [[x(at), plot.top], [x(at), plot.bottom]]);
    }
  }

  /** A round top that holds what there is, and that does not jump about. */
  #scale(lines) {
    const known = lines.flatMap((line) => line.values).filter(Number.isFinite).sort((a, b) => a - b);
    const high = Math.max(this.least, 1.1 * (known[Math.floor(0.995 * (known.length - 1))] ?? 0));
    const step = [1, 1.5, 2, 3, 4, 5, 8, 10].map((s) => s * 10 ** Math.floor(Math.log10(high))).find((s) => s >= high);
    if (step > this.top || step < 0.6 * this.top) this.top = step;
  }

  #drawAxes(palette, plot, x, y) {
    const { context } = this;
    context.font = '11px system-ui, sans-serif';
    context.fillStyle = palette.muted;
    context.strokeStyle = palette.line;
    context.lineWidth = 1;
    context.setLineDash([]);
    context.textAlign = 'right';
    context.textBaseline = 'middle';
    for (const value of [0, this.top / 2, this.top]) {
      const level = Math.round(y(value)) + 0.5;
      stroke(context, [[plot.left, level], [plot.right, level]]);
      context.fillText(value === this.top ? `${value}` : `${value}`, plot.left - 5, Math.max(level, 8));
    }
    context.textBaseline = 'alphabetic';
    for (const back of [30, 20, 10, 0]) {
      context.textAlign = back === 0 ? 'right' : back === 30 ? 'left' : 'center';
      const text = back === 0 ? 'now' : `−${back} s`;
      context.fillText(text, x(back), plot.bottom + 13);
    }
    context.textAlign = 'right';
    context.fillText(this.unit, plot.left - 5, plot.bottom + 13);
  }

  #drawRule(colour, plot, level) {
    const { context } = this;
    context.strokeStyle = colour;
    context.lineWidth = 1;
    context.setLineDash([3, 3]);
    stroke(context, [[plot.left, level], [plot.right, level]]);
  }

  #drawLine({ colour, values, dash, width, marks }, x, y, palette) {
    const { context } = this;
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.lineJoin = 'round';
    context.setLineDash(dash);
    const last = values.length - 1;
    const points = values.map((value, i) => Number.isFinite(value) ? [x((last - i) / FPS), y(value)] : null);
    context.beginPath();
    let isDown = false;
    for (const point of points) {
      if (point && isDown) context.lineTo(...point);
      else if (point) context.moveTo(...point);
      isDown = Boolean(point);
    }
    context.stroke();
    if (!marks) return;
    context.setLineDash([]);
    context.strokeStyle = palette.miss;
    points.forEach((point, i) => point && marks(values[i]) && cross(context, ...point));
  }
}

function stroke(context, points) {
  context.beginPath();
  points.forEach(([x, y], i) => (i ? context.lineTo(x, y) : context.moveTo(x, y)));
  context.stroke();
}

function cross(context, x, y) {
  stroke(context, [[x - 2.5, y - 2.5], [x + 2.5, y + 2.5]]);
  stroke(context, [[x - 2.5, y + 2.5], [x + 2.5, y - 2.5]]);
}
