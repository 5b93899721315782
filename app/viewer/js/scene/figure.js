import * as THREE from 'three';
import { toYUp } from '../space.js';
import { Limbs } from './limbs.js';
import { ghost, hull, hullDepth, makeShadow, solid } from './materials.js';

/** Frames ahead at which ghosts stand: a tenth of a second and so on to half a second. */
const GHOSTS = [3, 6, 9, 12, 15];
/** Frames ahead at which the radius is shown: a fifth of a second, where it still has the shape of a body. */
const HULL = 6;
const LIVE = { bone: 0.026, joint: 0.034 };
const GHOST = { bone: 0.013, joint: 0.016 };
const ECHO = { bone: 0.008, joint: 0.018 };
const HEAD = 0.105;
const BESIDE_M = 1.05;
const SPOT = new THREE.PlaneGeometry(1, 1).rotateX(-Math.PI / 2);

/**
 * One person in the room: the body as it is, the ghosts of what is to come, the radius about
 * an early one, and the echo of what was said of this very moment half a second ago.
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
    const make = (material, more) => new Limbs({ ...shape, material, ...more });
    const many = { poses: GHOSTS.length, detail: 'coarse', order: 2 };
    this.live = make(solid(LIVE.bone, this.head));
    this.copy = make(solid(LIVE.bone, this.head));
    this.echo = make(ghost(ECHO.bone, 0.9), { detail: 'coarse', order: 2 });
    this.ghosts = { personal: make(ghost(GHOST.bone, 0.8), many), base: make(ghost(GHOST.bone, 0.8), many) };
    const shell = { detail: 'round', order: 3 };
    this.tubes = { personal: make(hullDepth(), shell), base: make(hullDepth(), shell) };
    this.hulls = {
      personal: this.tubes.personal.add(hull(0.3, 0.6), 4), base: this.tubes.base.add(hull(0.28, 0.6), 4),
    };
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
    this.colours = { personal: new THREE.Color(palette.personal), base: new THREE.Color(palette.base) };
    for (const one of [this.live, this.copy]) one.material.uniforms.color.value.set(palette.truth);
    for (const [name, colour] of Object.entries(this.colours)) {
      this.ghosts[name].material.uniforms.color.value.copy(colour);
      this.hulls[name].uniforms.color.value.copy(colour);
    }
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
    this.live.set(0, pose, radius);
    const isPersonal = held.personal?.version.kind === 'personal';
    const twoColours = isPersonal && held.base;
    const personal = show.personal && isPersonal ? held.personal : null;
    const base = isPersonal ? (show.base ? held.base : null) : (held.base ?? held.personal);
    this.beside.position.x = show.beside && twoColours ? -BESIDE_M : 0;
    this.copy.set(0, show.beside && twoColours ? pose : null, radius);
    this.#foresee('personal', personal, show);
    this.#foresee('base', base, show);
    const said = past?.personal ?? past?.base;
    const isBase = said && said === past.base;
    this.echo.material.uniforms.color.value.copy(this.colours[isBase ? 'base' : 'personal']);
    const echo = show.echo && said ? this.#pose(said, GHOSTS.at(-1), show.up) : null;
    this.echo.set(0, echo, () => ECHO.joint);
  }

  #pose(forecast, ahead, up) {
    return toYUp(forecast.frames.subarray((ahead - 1) * this.width, ahead * this.width), up);
  }

  #foresee(name, forecast, show) {
    GHOSTS.forEach((ahead, i) => {
      const pose = forecast ? this.#pose(forecast, ahead, show.up) : null;
      this.ghosts[name].set(i, pose, () => GHOST.joint, 0.16 + 0.84 * ((i + 1) / GHOSTS.length) ** 2);
    });
    const joints = this.width / 3;
    const radii = show.tubes ? forecast?.radius?.subarray((HULL - 1) * joints, HULL * joints) : null;
    this.tubes[name].set(0, radii ? this.#pose(forecast, HULL, show.up) : null, (j) => radii[j]);
  }

  /** The first pose settles where the person stands, the lowest joint where the floor is. */
  #place(pose) {
    let lowest = Infinity;
    for (let i = 1; i < pose.length; i += 3) if (pose[i] < lowest) lowest = pose[i];
    const hips = Math.max(0, this.hips);
    if (!Number.isFinite(lowest)) return; // nothing of the person is seen
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
