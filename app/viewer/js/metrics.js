/** How far forecasts are from what came, in millimetres. */

/** Frames ahead at which errors are shown: a third of a second and half a second. */
export const HORIZONS = [10, 15];
export const FPS = 30;

/**
 * Whether a time lies that many frames after another, to half a frame.
 * @param {number} t seconds
 * @param {number} before seconds
 * @param {number} frames
 */
export function isAhead(t, before, frames) {
  return Math.abs((t - before) * FPS - frames) < 0.5;
}

/**
 * Mean distance per joint between two poses; joints that are missing in either are left out.
 * @param {Float32Array} a flat x, y, z per joint, metres, NaN where missing
 * @param {Float32Array} b
 * @param {number} [from] where the pose begins in `a`
 * @returns {number} millimetres, NaN where no joint is seen in both
 */
export function meanErrorMm(a, b, from = 0) {
  let sum = 0;
  let count = 0;
  for (let i = 0; i < b.length; i += 3) {
    const distance = Math.hypot(
      a[from + i] - b[i],
      a[from + i + 1] - b[i + 1],
      a[from + i + 2] - b[i + 2],
    );
    if (Number.isFinite(distance)) {
      sum += distance;
      count += 1;
    }
  }
  return count ? (1000 * sum) / count : NaN;
}

/**
 * The pose that a forecast has for some frames ahead.
 * @param {{frames: Float32Array}} forecast
 * @param {number} ahead 1 … 15
 * @param {number} width numbers of one pose
 */
export function poseAhead(forecast, ahead, width) {
  return forecast.frames.subarray((ahead - 1) * width, ahead * width);
}

/**
 * What was said of a frame some frames before it, and how wrong that was.
 * @param {Float32Array} truth the pose that came
 * @param {{joints: Float32Array | null, personal: any, base: any} | undefined} past
 *   the record of the frame from which it was forecast
 * @param {number} ahead frames between the two
 * @returns {{zero: number, base: number, personal: number}} millimetres, NaN where nothing was said
 */
export function scoreFrame(truth, past, ahead) {
  const none = { zero: NaN, base: NaN, personal: NaN };
  if (!truth || !past?.joints) return none;
  const error = (forecast) =>
    forecast ? meanErrorMm(poseAhead(forecast, ahead, truth.length), truth) : NaN;
  return {
    zero: meanErrorMm(past.joints, truth),
    base: error(past.base),
    personal: error(past.personal),
  };
}

/**
 * @param {number[]} values
 * @returns {number} mean of those that are finite, NaN where there is none
 */
export function mean(values) {
  const known = values.filter(Number.isFinite);
  return known.length ? known.reduce((sum, value) => sum + value, 0) / known.length : NaN;
}

/**
 * @param {number[]} values
 * @param {number} share 0 … 1
 * @returns {number} the smallest value that at least this share does not exceed, NaN for none
 */
export function quantile(values, share) {
  const known = values.filter(Number.isFinite).sort((a, b) => a - b);
  if (!known.length) return NaN;
  return known[Math.max(0, Math.ceil(share * known.length) - 1)];
}

/**
 * A mean that moves along: each value becomes the mean of itself and those before it.
 * @param {number[]} values
 * @param {number} width how many
 */
export function smooth(values, width) {
  return values.map((value, i) =>
    Number.isFinite(value) ? mean(values.slice(Math.max(0, i - width + 1), i + 1)) : NaN,
  );
}
