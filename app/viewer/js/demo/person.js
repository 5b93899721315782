import { GESTURES, makeWalk, strength } from './actions.js';
import { REST, makeBody, poseBody } from './body.js';
import { randomOf } from './vectors.js';

const FPS = 30;
const PAUSE_S = 0.5;
const WHAT = ['wave', 'throw', 'squat', 'walk', 'circle', 'sit', 'throw', 'reach', 'clap', 'stretch'];

/**
 * Somebody who does one thing after another, in the skeleton `kinect_v1`, y up, metres; the same
 * seed gives the same person and motion.
 */
export class SyntheticPerson {
  /** @param {number} seed */
  constructor(seed) {
    this.isYUp = true; // and is to be turned into the axes of whom it plays
    this.random = randomOf(seed * 7919 + 17);
    const vary = (least, most) => least + (most - least) * this.random();
    this.body = makeBody(vary(0.93, 1.07));
    this.manner = { tempo: vary(0.85, 1.15), amplitude: vary(0.85, 1.1), stoop: vary(0, 0.09) };
    this.phases = Array.from({ length: 18 }, () => vary(0, 2 * Math.PI));
    this.floor = -1.0;
    this.home = [0, 0, 2.8];
    this.offset = 3 * ((seed - 1) % 3);
    this.segments = [];
    this.end = 0;
  }

  get name() { return 'Synthetic person'; }
  get skeleton() { return 'kinect_v1'; }

  /**
   * @param {number} n frame, 30 a second
   * @returns {{joints: Float32Array, action: string}}
   */
  frame(n) {
    const t = n / FPS;
    const segment = this.#find(t);
    const joints = poseBody(this.body, this.#pose(segment, t - segment.begin, t));
    const flat = new Float32Array(60);
    joints.forEach((joint, j) => {
      flat[3 * j] = joint[0] + this.#noise(j, t);
      flat[3 * j + 1] = joint[1] + this.floor + this.#noise(j + 7, t);
      flat[3 * j + 2] = joint[2] + this.#noise(j + 13, t);
    });
    return { joints: flat, action: segment.action };
  }

  #find(t) {
    while (this.end <= t) this.#write();
    while (this.segments.length > 1 && this.segments[1].begin <= t) this.segments.shift();
    return this.segments[0];
  }

  #write() {
    const count = this.written ?? 0;
    this.written = count + 1;
    const action = WHAT[(count + this.offset) % WHAT.length];
    const walk = action === 'walk' ? makeWalk({ from: this.home, manner: this.manner, wide: 0.09 }) : null;
    const seconds = walk ? walk.seconds : GESTURES[action].seconds * (0.9 + 0.25 * this.random());
    this.segments.push({ action, begin: this.end, seconds, walk });
    this.end += seconds + PAUSE_S;
  }

  #pose(segment, local, t) {
    if (segment.walk) {
      const walked = segment.walk.at(Math.min(local, segment.seconds));
      return { ...walked, controls: this.#settle(walked.controls, strength(local, segment.seconds), t) };
    }
    const asked = GESTURES[segment.action].pose(local, this.manner);
    const [x, , z] = this.home;
    return {
      place: this.home, heading: 0,
      feet: { right: [x + 0.09, 0, z], left: [x - 0.09, 0, z], heading: 0 },
      controls: this.#settle(asked, strength(local, segment.seconds), t),
    };
  }

  /** Between rest and what an action asks for, never quite still. */
  #settle(asked, share, t) {
    const controls = { ...REST, lean: REST.lean + this.manner.stoop };
    for (const [name, value] of Object.entries(asked)) {
      controls[name] += (value - controls[name]) * share;
    }
    const sway = (k, hertz) => Math.sin(2 * Math.PI * hertz * t + this.phases[k]);
    controls.side += 0.008 * sway(0, 0.23);
    controls.back += 0.006 * sway(1, 0.31);
    controls.twist += 0.02 * sway(2, 0.17);
    controls.look += 0.12 * sway(3, 0.13);
    controls.nod += 0.03 * sway(4, 0.19);
    controls.rightForward += 0.015 * sway(5, 0.27);
    controls.leftForward += 0.015 * sway(6, 0.21);
    return controls;
  }

  /** What a depth camera adds: a slow offset of each joint, and a little white noise. */
  #noise(k, t) {
    const slow = Math.sin(2 * Math.PI * (0.07 + 0.011 * (k % 9)) * t + this.phases[k % 18]);
    return 0.004 * slow + 0.004 * (this.random() - 0.5);
  }
}
