/**
 * What synthetic people do: each action gives the controls of a body at a time.
 *
 * An action begins and ends at rest; `strength` (0 … 1) is how far it is on.
 */
import { ease } from './vectors.js';

const TAU = 2 * Math.PI;

/** @typedef {{seconds: number, pose: (t: number, manner: any) => Record<string, number>}} Action */

/** @type {Record<string, Action>} */
export const GESTURES = {
  wave: {
    seconds: 4.2,
    pose: (t, { tempo, amplitude }) => ({
      rightOut: 0.4 + 0.38 * amplitude * Math.sin(TAU * 0.8 * tempo * t),
      rightUp: 0.55, rightForward: 0.3, side: -0.015, nod: 0.03,
    }),
  },
  reach: {
    seconds: 3.4,
    pose: (t, { amplitude }) => ({
      rightOut: -0.05, rightUp: 0.12 * Math.sin(TAU * 0.3 * t), rightForward: 0.88 * amplitude,
      lean: 0.26, twist: 0.32, back: 0.05, nod: 0.1,
    }),
  },
  sit: {
    seconds: 6,
    pose: (t, { tempo }) => ({
      drop: 0.4, back: 0.3, lean: 0.16 + 0.05 * Math.sin(TAU * 0.25 * tempo * t),
      rightOut: 0.02, rightUp: -0.48, rightForward: 0.62 + 0.06 * Math.sin(TAU * 0.9 * tempo * t),
      leftOut: 0.02, leftUp: -0.48, leftForward: 0.62 + 0.06 * Math.cos(TAU * 0.9 * tempo * t),
      nod: 0.18,
    }),
  },
  clap: {
    seconds: 3.2,
    pose: (t, { tempo, amplitude }) => {
      const apart = 0.1 + 0.32 * amplitude * Math.sin(TAU * 0.85 * tempo * t) ** 2;
      return {
        rightOut: apart - 0.28, rightUp: -0.18, rightForward: 0.62,
        leftOut: apart - 0.28, leftUp: -0.18, leftForward: 0.62,
      };
    },
  },
  squat: {
    seconds: 4.4,
    pose: (t, { tempo, amplitude }) => {
      const deep = amplitude * Math.sin(Math.PI * 0.45 * tempo * t) ** 2;
      return {
        drop: 0.36 * deep, back: 0.16 * deep, lean: 0.04 + 0.5 * deep,
        rightUp: -0.95 + 0.9 * deep, rightForward: 0.12 + 0.8 * deep,
        leftUp: -0.95 + 0.9 * deep, leftForward: 0.12 + 0.8 * deep,
      };
    },
  },
  circle: {
    seconds: 4.6,
    pose: (t, { tempo, amplitude }) => ({
      rightOut: 0.25 + 0.5 * amplitude * Math.sin(TAU * 0.6 * tempo * t),
      rightUp: 0.1 + 0.5 * amplitude * Math.cos(TAU * 0.6 * tempo * t), rightForward: 0.55,
    }),
  },
  throw: {
    seconds: 3.6,
    pose: (t, { tempo, amplitude }) => {
      const swing = Math.sin(TAU * 0.55 * tempo * t);
      return {
        rightOut: 0.25, rightUp: 0.15 + 0.5 * amplitude * Math.cos(TAU * 0.55 * tempo * t),
        rightForward: 0.15 + 0.75 * amplitude * swing, twist: 0.35 * swing, lean: 0.08 + 0.14 * swing,
      };
    },
  },
  stretch: {
    seconds: 4,
    pose: (t, { tempo }) => ({
      rightOut: 0.3, rightUp: 0.85, rightForward: 0.05, leftOut: 0.3, leftUp: 0.85,
      leftForward: 0.05, lean: -0.04, side: 0.05 * Math.sin(TAU * 0.4 * tempo * t),
      twist: 0.18 * Math.sin(TAU * 0.4 * tempo * t),
    }),
  },
};

/** How far a gesture is on, a while after its begin. */
export function strength(t, seconds) {
  return ease(t / 0.7) * ease((seconds - t) / 0.7);
}

/**
 * A walk of one round, whose first step leads forward; it ends where it began, facing alike.
 * @param {{from: number[], manner: any, wide: number, floor?: number}} options
 */
export function makeWalk({ from, manner, wide }) {
  const radius = 0.5 * manner.amplitude;
  const long = TAU * radius;
  const steps = 2 * Math.round(long / (2 * 0.4 * manner.amplitude));
  const stride = long / steps;
  const seconds = ((steps + 2) * 0.5) / manner.tempo;
  const follow = (s, aside) => {
    const angle = Math.min(1, Math.max(0, s / long)) * TAU;
    const r = radius - aside;
    return {
      at: [from[0] + radius - r * Math.cos(angle), 0, from[2] - r * Math.sin(angle)],
      heading: -angle,
    };
  };
  const foot = (phase, side) => {
    const sign = side === 'right' ? 1 : -1;
    const mine = side === 'right' ? 0 : 1;
    const last = Math.floor((phase - mine) / 2) * 2 + mine;
    const before = clamp((last - 1) * stride, 0, long);
    const after = clamp((last + 1) * stride, 0, long);
    const moved = last < 0 || last > steps ? 0 : ease((phase - last - 0.08) / 0.84);
    const s = last < 0 ? 0 : before + (after - before) * moved;
    const place = follow(s, sign * wide).at;
    const lift = after > before ? 0.07 * Math.sin(Math.PI * moved) : 0;
    return [place[0], lift, place[2]];
  };
  return {
    seconds,
    at(t) {
      const phase = (steps + 1) * glide(t / seconds);
      const s = clamp((phase - 0.5) * stride, 0, long);
      const swing = 0.34 * manner.amplitude * Math.cos(Math.PI * phase) * strength(t, seconds);
      const { at, heading } = follow(s, 0);
      return {
        place: at, heading,
        feet: { right: foot(phase, 'right'), left: foot(phase, 'left'), heading },
        controls: {
          drop: 0.02 + 0.016 * Math.cos(TAU * phase), lean: 0.07, twist: 0.22 * swing,
          side: 0.018 * Math.sin(Math.PI * phase),
          rightForward: 0.14 - swing, leftForward: 0.14 + swing, rightUp: -0.93, leftUp: -0.93,
        },
      };
    },
  };
}

function clamp(value, least, most) {
  return Math.min(most, Math.max(least, value));
}

/** From 0 to 1 at a steady pace, with a gentle begin and end. */
function glide(x) {
  const soft = 0.12;
  const pace = 1 / (1 - soft);
  const s = clamp(x, 0, 1);
  if (s < soft) return (pace * s * s) / (2 * soft);
  if (s > 1 - soft) return 1 - (pace * (1 - s) ** 2) / (2 * soft);
  return pace * (s - soft / 2);
}
