import * as THREE from 'three';
import { IS_SOFTWARE } from './software.js';

/** Sides of a bone, and rings and sides of a joint, by how closely they are looked at. */
const DETAIL = IS_SOFTWARE
  ? { fine: [7, 5, 8], coarse: [4, 2, 4], round: [8, 4, 8] }
  : { fine: [10, 8, 12], coarse: [5, 3, 6], round: [12, 8, 12] };

/**
 * Poses of one skeleton as round bones and joints, in one call to the card.
 *
 * Bones and joints are built once; the vertex shader puts them where the joints are. Bones taper from
 * the radius of one joint to that of the other, unless they have a thickness of their own.
 */
export class Limbs {
  /**
   * @param {{bones: number[][], joints: number, poses?: number, detail?: keyof typeof DETAIL,
   *   material: (count: number, poses: number) => THREE.ShaderMaterial, order?: number}} options
   */
  constructor({ bones, joints, poses = 1, detail = 'fine', material, order = 0 }) {
    this.joints = joints;
    this.poses = poses;
    this.group = new THREE.Group();
    this.geometry = build(bones, joints, poses, DETAIL[detail]);
    this.places = Array.from({ length: poses * joints }, () => new THREE.Vector4());
    this.fades = new Array(poses).fill(0);
    this.material = this.add(material, order);
  }

  /** Look at the same shapes once more, with another material. */
  add(material, order) {
    const made = material(this.places.length, this.poses);
    made.uniforms.places.value = this.places;
    made.uniforms.fades.value = this.fades;
    const mesh = new THREE.Mesh(this.geometry, made);
    mesh.frustumCulled = false;
    mesh.renderOrder = order;
    this.group.add(mesh);
    return made;
  }

  /**
   * @param {number} index which of the poses
   * @param {Float32Array | null} pose y up, metres; null hides it
   * @param {(joint: number) => number} radius of the joints, metres
   * @param {number} [fade] 0 … 1
   */
  set(index, pose, radius, fade = 1) {
    this.fades[index] = pose ? fade : 0;
    this.group.visible = this.fades.some((one) => one > 0);
    for (let j = 0; j < this.joints; j++) {
      const place = this.places[index * this.joints + j];
      if (pose && Number.isFinite(pose[3 * j])) place.set(pose[3 * j], pose[3 * j + 1], pose[3 * j + 2], radius(j));
      else place.set(0, 0, 0, 0); // no radius: not seen
    }
  }

  dispose() {
    this.group.removeFromParent();
    this.geometry.dispose();
    for (const mesh of this.group.children) mesh.material.dispose();
  }
}

/** Every vertex says where on its bone or joint it lies, between which joints, in which pose. */
function build(bones, joints, poses, [sides, rings, around]) {
  const local = [];
  const ends = [];
  const index = [];
  const add = (vertices, faces, a, b, pose) => {
    const begin = local.length / 3;
    for (const vertex of vertices) {
      local.push(...vertex);
      ends.push(a, b, pose);
    }
    for (const corner of faces) index.push(begin + corner);
  };
  const bone = makeBone(sides);
  const ball = makeBall(rings, around);
  for (let pose = 0; pose < poses; pose++) {
    const first = pose * joints;
    for (const [a, b] of bones) add(bone.vertices, bone.faces, first + a, first + b, pose);
    for (let j = 0; j < joints; j++) add(ball.vertices, ball.faces, first + j, first + j, pose);
  }
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute('position', new THREE.Float32BufferAttribute(local, 3));
  geometry.setAttribute('ends', new THREE.Float32BufferAttribute(ends, 3));
  geometry.setIndex(index);
  return geometry;
}

/** An open cylinder: two numbers about it, and 0 … 1 along it. */
function makeBone(sides) {
  const vertices = [];
  const faces = [];
  for (let i = 0; i < sides; i++) {
    const angle = (2 * Math.PI * i) / sides;
    vertices.push([Math.cos(angle), Math.sin(angle), 0], [Math.cos(angle), Math.sin(angle), 1]);
    const [a, b, c, d] = [2 * i, 2 * i + 1, (2 * i + 2) % (2 * sides), (2 * i + 3) % (2 * sides)];
    faces.push(a, b, c, c, b, d);
  }
  return { vertices, faces };
}

function makeBall(rings, around) {
  const ball = new THREE.SphereGeometry(1, around, rings);
  const at = ball.attributes.position;
  const vertices = Array.from({ length: at.count }, (_, i) => [at.getX(i), at.getY(i), at.getZ(i)]);
  return { vertices, faces: [...ball.index.array] };
}
