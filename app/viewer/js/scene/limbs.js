import * as THREE from 'three';

/** Shapes by how closely they are looked at: much is thin, and a card in software counts triangles. */
const SHAPES = {
  fine: [new THREE.CylinderGeometry(1, 1, 1, 10, 1, true), new THREE.SphereGeometry(1, 14, 10)],
  coarse: [new THREE.CylinderGeometry(1, 1, 1, 5, 1, true), new THREE.SphereGeometry(1, 6, 4)],
  round: [new THREE.CylinderGeometry(1, 1, 1, 10, 1, true), new THREE.SphereGeometry(1, 10, 8)],
};
const UP = new THREE.Vector3(0, 1, 0);
const matrix = new THREE.Matrix4();
const middle = new THREE.Vector3();
const way = new THREE.Vector3();
const size = new THREE.Vector3();
const turn = new THREE.Quaternion();
const level = new THREE.Quaternion();

/** Poses of one skeleton as round bones and joints; several poses share two calls to the card. */
export class Limbs {
  /**
   * @param {{bones: number[][], joints: number, poses: number, material: THREE.Material,
   *   order?: number, shape?: keyof typeof SHAPES}} options
   */
  constructor({ bones, joints, poses, material, order = 0, shape = 'fine' }) {
    this.bones = bones;
    this.joints = joints;
    this.poses = poses;
    this.group = new THREE.Group();
    this.seen = new Array(poses).fill(true);
    const [bone, joint] = SHAPES[shape];
    this.cylinders = this.#make(bone, bones.length * poses, material, order);
    this.spheres = this.#make(joint, joints * poses, material, order);
  }

  /** A second look at the same shapes, such as a pass that only fills the depth. */
  repeat(material, order) {
    for (const mesh of [this.cylinders, this.spheres]) {
      const again = new THREE.InstancedMesh(mesh.geometry, material, mesh.count);
      again.instanceMatrix = mesh.instanceMatrix;
      again.frustumCulled = false;
      again.renderOrder = order;
      this.group.add(again);
    }
  }

  #make(geometry, count, material, order) {
    const own = geometry.clone();
    const fade = new Float32Array(count).fill(1);
    own.setAttribute('fade', new THREE.InstancedBufferAttribute(fade, 1));
    const mesh = new THREE.InstancedMesh(own, material, count);
    mesh.frustumCulled = false;
    mesh.renderOrder = order;
    mesh.instanceMatrix.setUsage(THREE.DynamicDrawUsage);
    this.group.add(mesh);
    return mesh;
  }

  /**
   * @param {number} index which of the poses
   * @param {Float32Array | null} pose y up; null hides it
   * @param {{bone: number, joint: number} | ((joint: number) => number)} thick metres; a function
   *   gives the radius about each joint
   * @param {number} [fade] 0 … 1
   */
  set(index, pose, thick, fade = 1) {
    this.seen[index] = Boolean(pose);
    this.group.visible = this.seen.includes(true);
    if (!this.group.visible) return;
    const radius = typeof thick === 'function' ? thick : () => thick.joint;
    for (let j = 0; j < this.joints; j++) {
      const seen = pose && Number.isFinite(pose[3 * j]);
      const r = seen ? radius(j) : 0;
      middle.set(seen ? pose[3 * j] : 0, seen ? pose[3 * j + 1] : -9, seen ? pose[3 * j + 2] : 0);
      matrix.compose(middle, level, size.setScalar(r));
      this.spheres.setMatrixAt(index * this.joints + j, matrix);
      this.spheres.geometry.attributes.fade.array[index * this.joints + j] = fade;
    }
    this.bones.forEach(([a, b], k) => this.#setBone(index * this.bones.length + k, pose, a, b, thick, fade));
    for (const mesh of [this.cylinders, this.spheres]) {
      mesh.instanceMatrix.needsUpdate = true;
      mesh.geometry.attributes.fade.needsUpdate = true;
    }
  }

  #setBone(at, pose, a, b, thick, fade) {
    const seen = pose && Number.isFinite(pose[3 * a] + pose[3 * b]);
    if (seen) {
      way.set(pose[3 * b] - pose[3 * a], pose[3 * b + 1] - pose[3 * a + 1], pose[3 * b + 2] - pose[3 * a + 2]);
      const long = way.length();
      middle.set(pose[3 * a], pose[3 * a + 1], pose[3 * a + 2]).addScaledVector(way, 0.5);
      turn.setFromUnitVectors(UP, way.divideScalar(Math.max(long, 1e-6)));
      const r = typeof thick === 'function' ? (thick(a) + thick(b)) / 2 : thick.bone;
      matrix.compose(middle, turn, size.set(r, long, r));
    } else {
      matrix.makeScale(0, 0, 0);
    }
    this.cylinders.setMatrixAt(at, matrix);
    this.cylinders.geometry.attributes.fade.array[at] = fade;
  }

  dispose() {
    this.group.removeFromParent();
    for (const mesh of this.group.children) mesh.geometry.dispose();
  }
}
