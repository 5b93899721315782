/**
 * A body in the skeleton `kinect_v1`: bones of constant length, posed by a few controls.
 *
 * In a person's own axes x is right, y up and z backward: who faces the sensor looks towards -z and
 * has the right side at +x, as in recordings of a Kinect.
 */
import { add, dot, length, scale, sub, tip, turn, unit } from './vectors.js';

/** Sizes in metres of somebody 1.7 m tall. */
const SIZES = {
  spine: 0.065, neck: 0.335, head: 0.185,
  shoulderOut: 0.165, shoulderDown: 0.1, hipOut: 0.085, hipDown: 0.075,
  upperArm: 0.265, forearm: 0.235, hand: 0.07, thigh: 0.435, shank: 0.38, foot: 0.075, ankle: 0.075,
};

/** What poses a body. Wrists are relative to their shoulders: out, up, forward, in arm lengths. */
export const REST = Object.freeze({
  drop: 0, back: 0, side: 0, lean: 0.04, twist: 0, nod: 0, look: 0,
  rightOut: 0.16, rightUp: -0.95, rightForward: 0.12,
  leftOut: 0.16, leftUp: -0.95, leftForward: 0.12,
});

/** @param {number} tall how tall, as a share of 1.7 m */
export function makeBody(tall) {
  const sizes = Object.fromEntries(Object.entries(SIZES).map(([name, size]) => [name, size * tall]));
  return {
    ...sizes,
    arm: sizes.upperArm + sizes.forearm,
    hips: sizes.thigh + sizes.shank + sizes.ankle + sizes.hipDown - 0.012,
  };
}

/**
 * @param {ReturnType<typeof makeBody>} body
 * @param {{place: number[], heading: number, controls: typeof REST,
 *   feet: {right: number[], left: number[], heading: number}}} pose feet on a floor at y = 0
 * @returns {number[][]} the 20 joints
 */
export function poseBody(body, { place, heading, controls: c, feet }) {
  const joints = new Array(20);
  const out = (v) => turn(v, heading);
  const hips = add(place, out([c.side, body.hips - c.drop, c.back]));
  const trunk = (v) => out(tip(v, c.lean));
  const shoulders = (v) => turn(tip(v, c.lean), heading + c.twist);
  joints[3] = hips;
  joints[2] = add(hips, trunk([0, body.spine, 0.03]));
  joints[1] = add(joints[2], trunk([0, body.neck, -0.01]));
  joints[0] = add(joints[1], turn(tip([0, body.head, -0.02], c.lean + c.nod), heading + c.look));
  for (const [name, first, sign] of [['left', 4, -1], ['right', 8, 1]]) {
    const shoulder = add(joints[1], shoulders([sign * body.shoulderOut, -body.shoulderDown, 0]));
    const reach = [c[`${name}Out`] * sign, c[`${name}Up`], -c[`${name}Forward`]];
    const wrist = add(shoulder, turn(scale(reach, body.arm), heading + c.twist));
    const pole = turn([sign * 0.45, -0.7, 0.75], heading + c.twist);
    const [elbow, end] = reachOut(shoulder, wrist, body.upperArm, body.forearm, pole);
    const hand = add(end, scale(unit(sub(end, elbow)), body.hand));
    joints.splice(first, 4, shoulder, elbow, end, hand);
  }
  for (const [name, first, sign] of [['left', 12, -1], ['right', 16, 1]]) {
    const hip = add(hips, out([sign * body.hipOut, -body.hipDown, 0]));
    const ankle = add(feet[name], [0, body.ankle, 0]);
    const pole = turn([sign * 0.12, 0, -1], feet.heading);
    const [knee, end] = reachOut(hip, ankle, body.thigh, body.shank, pole);
    const foot = add(end, turn([sign * 0.012, -0.05, -body.foot], feet.heading));
    joints.splice(first, 4, hip, knee, end, foot);
  }
  return joints;
}

/** Two bones from a joint towards a target: the middle joint is on the side of the pole. */
function reachOut(from, target, upper, lower, pole) {
  const way = sub(target, from);
  const far = Math.min(length(way), 0.995 * (upper + lower));
  const near = Math.max(far, Math.abs(upper - lower) + 0.02);
  const ahead = unit(way);
  const along = (upper * upper - lower * lower + near * near) / (2 * near);
  const off = Math.sqrt(Math.max(0, upper * upper - along * along));
  const aside = unit(sub(pole, scale(ahead, dot(pole, ahead))));
  const middle = add(from, add(scale(ahead, along), scale(aside, off)));
  return [middle, add(from, scale(ahead, near))];
}
