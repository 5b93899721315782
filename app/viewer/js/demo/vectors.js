/** Points as arrays of three numbers: x, y, z in metres, y up. */

export const add = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
export const scale = (a, s) => [a[0] * s, a[1] * s, a[2] * s];
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const length = (a) => Math.hypot(a[0], a[1], a[2]);
export const mix = (a, b, s) => a.map((value, i) => value + (b[i] - value) * s);

export function unit(a) {
  const long = length(a);
  return long > 1e-9 ? scale(a, 1 / long) : [0, 1, 0];
}

/** Turn about the vertical axis; 0 faces -z, positive turns to the left. */
export function turn([x, y, z], angle) {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return [c * x + s * z, y, -s * x + c * z];
}

/** Tip forward, towards -z, about the axis to the right. */
export function tip([x, y, z], angle) {
  const c = Math.cos(angle);
  const s = Math.sin(angle);
  return [x, c * y + s * z, -s * y + c * z];
}

/** From 0 to 1 as x goes from 0 to 1, without a jerk. */
export function ease(x) {
  const s = Math.min(1, Math.max(0, x));
  return s * s * s * (s * (6 * s - 15) + 10);
}

/**
 * Random numbers that are the same for the same seed (mulberry32).
 * @param {number} seed
 */
export function randomOf(seed) {
  let state = seed >>> 0;
  return () => {
    state = (state + 0x6d2b79f5) >>> 0;
    let t = Math.imul(state ^ (state >>> 15), 1 | state);
    t = (t + Math.imul(t ^ (t >>> 7), 61 | t)) ^ t;
    return ((t ^ (t >>> 14)) >>> 0) / 2 ** 32;
  };
}
