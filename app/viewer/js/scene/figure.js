import * as THREE from 'three';
import { toYUp } from '../space.js';
import { Limbs } from './limbs.js';
import { makeGhost, makeShadow, makeShell, makeSolid } from './materials.js';

/** Frames ahead at which ghosts stand: a tenth of a second and so on to half a second. */
const GHOSTS = [3, 6, 9, 12, 15];
const LIVE = { bone: 0.026, joint: 0.034 };
const GHOST = { bone: 0.013, joint: 0.016 };
const ECHO = { bone: 0.008, joint: 0.018 };
const HEAD = 0.105;
const BESIDE_M = 1.05;
const SPOT = new THREE.PlaneGeometry(1, 1).rotateX(-Math.PI / 2);

/**
 * One person in the room: the body as it is, the ghosts of what is to come, the radius about the
 * last of them, and the echo of what was said of this very moment half a second ago.
 */
export class Figure {
  /** @param {{bones: number[][], joints: {name: string}[]}} skeleton */
  constructor(skeleton) {
    const shape = { bones: skeleton.bones, joints: skeleton.joints.length };
    this.head = skeleton.joints.findIndex((joint) => /^(head|nose)$/i.test(joint.name));
    this.hips = skeleton.joints.findIndex((joint) => /^(hip_?cent(er|re)|spinebase|pelvis|midhip|hip|left_hip)$/i.test(joint.name));
    this.width = 3 * shape.joints;
    this.group = new THREE.Group();
    this.beside = new THREE.Group();
    this.materials = {
      live: makeSolid(), personal: makeGhost(0.8), base: makeGhost(0.8),
      echo: makeGhost(0.9), personalShell: makeShell(0.3, 0.45), baseShell: makeShell(0.26, 0.45),
    };
    const { live, personal, base, echo, personalShell, baseShell } = this.materials;
    this.live = new Limbs({ ...shape, poses: 1, material: live });
    this.copy = new Limbs({ ...shape, poses: 1, material: live });
    this.echo = new Limbs({ ...shape, poses: 1, material: echo, order: 2, shape: 'coarse' });
    this.ghosts = {
      personal: new Limbs({ ...shape, poses: GHOSTS.length, material: personal, order: 2, shape: 'coarse' }),
      base: new Limbs({ ...shape, poses: GHOSTS.length, material: base, order: 2, shape: 'coarse' }),
    };
    this.tubes = {
      personal: new Limbs({ ...shape, poses: 1, material: personalShell.depth, order: 3, shape: 'round' }),
      base: new Limbs({ ...shape, poses: 1, material: baseShell.depth, order: 3, shape: 'round' }),
    };
    this.tubes.personal.repeat(personalShell.colour, 4);
    this.tubes.base.repeat(baseShell.colour, 4);
    this.shadows = [0.9, 0.34, 0.34].map((wide) => {
      const spot = new THREE.Mesh(SPOT, this.shadowMaterial ??= makeShadow());
      spot.scale.setScalar(wide);
      spot.renderOrder = -1;
      this.group.add(spot);
      return spot;
    });
    this.group.add(this.live.group, this.echo.group, this.ghosts.personal.group, this.tubes.personal.group);
    this.beside.add(this.ghosts.base.group, this.tubes.base.group, this.copy.group);
    this.group.add(this.beside);
    this.anchor = null;
  }

  /** @param {Record<string, string>} palette */
  paint(palette) {
    const { live, personal, base, echo, personalShell, baseShell } = this.materials;
    live.color.set(palette.truth);
    echo.uniforms.color.value.set(palette.personal);
    for (const one of [personal, personalShell.depth, personalShell.colour]) one.uniforms.color.value.set(palette.personal);
    for (const one of [base, baseShell.depth, baseShell.colour]) one.uniforms.color.value.set(palette.base);
  }

  /**
   * @param {import('../performer.js').Moment} moment what is shown as now
   * @param {any} held the moment whose forecast is shown, `moment` itself where it follows
   * @param {any} past the moment half a second before, for the echo
   * @param {{up: string, base: boolean, personal: boolean, beside: boolean, tubes: boolean, echo: boolean}} show
   */
  set(moment, held, past, show) {
    const pose = moment.joints && toYUp(moment.joints, show.up);
    if (pose) this.#place(pose);
    const radius = (j) => (j === this.head ? HEAD : LIVE.joint);
    this.live.set(0, pose, pose ? (j) => radius(j) : LIVE);
    if (pose) this.#thin(this.live, pose);
    const twoColours = held.personal && held.base && held.personal !== held.base;
    const personal = show.personal && twoColours ? held.personal : null;
    const base = show.base || !twoColours ? held.base : null;
    this.beside.position.x = show.beside && twoColours ? -BESIDE_M : 0;
    this.copy.set(0, show.beside && twoColours ? pose : null, LIVE);
    this.#foresee('personal', personal, show);
    this.#foresee('base', base, show);
    const said = past?.personal ?? past?.base;
    const isBase = said && said === past.base;
    this.materials.echo.uniforms.color.value.copy(this.materials[isBase ? 'base' : 'personal'].uniforms.color.value);
    const echo = show.echo && said ? this.#pose(said, GHOSTS.at(-1), show.up) : null;
    this.echo.set(0, echo, ECHO);
  }

  #thin(limbs, pose) {
    // Bones keep one thickness, whatever the size of the head.
    limbs.set(0, pose, LIVE);
    if (this.head < 0 || !Number.isFinite(pose[3 * this.head])) return;
    const matrix = new THREE.Matrix4().makeScale(HEAD * 0.78, HEAD, HEAD * 0.86);
    matrix.setPosition(pose[3 * this.head], pose[3 * this.head + 1], pose[3 * this.head + 2]);
    limbs.spheres.setMatrixAt(this.head, matrix);
  }

  #pose(forecast, ahead, up) {
    return toYUp(forecast.frames.subarray((ahead - 1) * this.width, ahead * this.width), up);
  }

  #foresee(name, forecast, show) {
    GHOSTS.forEach((ahead, i) => {
      const pose = forecast ? this.#pose(forecast, ahead, show.up) : null;
      this.ghosts[name].set(i, pose, GHOST, 0.16 + 0.84 * ((i + 1) / GHOSTS.length) ** 2);
    });
    const last = GHOSTS.at(-1);
    const joints = this.width / 3;
    const radii = show.tubes ? forecast?.radius?.subarray((last - 1) * joints, last * joints) : null;
    this.tubes[name].set(0, radii ? this.#pose(forecast, last, show.up) : null, (j) => radii[j]);
  }

  /** The first pose settles where the person stands, the lowest joint where the floor is. */
  #place(pose) {
    let lowest = Infinity;
    for (let i = 1; i < pose.length; i += 3) if (pose[i] < lowest) lowest = pose[i];
    const hips = Math.max(0, this.hips);
    if (!this.anchor) {
      if (!Number.isFinite(pose[3 * hips])) return;
      this.anchor = { x: pose[3 * hips], z: pose[3 * hips + 2], floor: lowest };
    }
    this.anchor.floor += (lowest - this.anchor.floor) * (lowest < this.anchor.floor ? 0.2 : 0.002);
    const { x, z, floor } = this.anchor;
    for (const child of this.group.children) if (child !== this.beside) child.position.set(-x, -floor, -z);
    this.beside.position.set(this.beside.position.x, -floor, -z);
    for (const child of this.beside.children) child.position.x = -x;
    const feet = [...Array(pose.length / 3).keys()].filter((j) => pose[3 * j + 1] < lowest + 0.25);
    const spots = [hips, feet[0] ?? hips, feet.at(-1) ?? hips];
    this.shadows.forEach((spot, i) => {
      const j = spots[i];
      spot.position.set(pose[3 * j] - x, 0.002 + 0.001 * i, pose[3 * j + 2] - z);
    });
  }

  /** Forget where the person stood, as after another recording. */
  settle() { this.anchor = null; }

  dispose() {
    for (const limbs of [this.live, this.copy, this.echo, ...Object.values(this.ghosts), ...Object.values(this.tubes)]) limbs.dispose();
    this.group.removeFromParent();
  }
}
