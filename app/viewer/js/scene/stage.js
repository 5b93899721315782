import * as THREE from 'three';
import { OrbitControls } from 'three/OrbitControls.js';
import { Floor } from './floor.js';
import { IS_SOFTWARE } from './software.js';

/** Where the camera may stand; the sensor is at -z, so that nobody is mirrored. */
const VIEWS = {
  sensor: [0.0, 1.45, -1],
  corner: [0.62, 0.85, -1],
  side: [1, 0.45, 0.02],
  top: [0.0, 1, -0.02],
};
const LOOK_AT = new THREE.Vector3(0, 0.88, 0);
/** Between pictures of people who move at 30 Hz; a longer gap than the second is rest. */
const SLOW_MS = 37;
const REST_MS = 250;
const STEP = 0.08;

/** The room: camera and floor; draws when asked. */
export class Stage {
  /** @param {HTMLCanvasElement} canvas */
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: !IS_SOFTWARE, powerPreference: 'low-power' });
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(34, 1, 0.1, 60);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = !matchMedia('(prefers-reduced-motion: reduce)').matches;
    this.controls.maxPolarAngle = 0.495 * Math.PI;
    this.controls.minDistance = 1.5;
    this.controls.maxDistance = 14;
    this.controls.target.copy(LOOK_AT);
    this.width = 1;
    this.ratio = Math.min(devicePixelRatio, 2);
    this.slow = 0;
    this.floor = new Floor();
    this.scene.add(this.floor.mesh);
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    canvas.addEventListener('keydown', (event) => this.#steer(event));
    this.resize();
    this.look('corner');
  }

  /** Show this many people beside each other. */
  frame(people) {
    this.people = people;
    this.look(this.view ?? 'corner');
  }

  /** @param {keyof typeof VIEWS} view */
  look(view) {
    this.view = view;
    const way = new THREE.Vector3(...VIEWS[view]);
    if (view === 'sensor') way.y = 0.18;
    if (view === 'corner') way.y = 0.3;
    way.normalize();
    const wide = 1.4 + 1.35 * Math.max(1, this.people ?? 1);
    const half = Math.tan((this.camera.fov * Math.PI) / 360);
    const far = Math.max(2.5 / (2 * half), wide / (2 * half * this.camera.aspect)) + 0.5;
    this.controls.target.copy(LOOK_AT);
    this.camera.position.copy(LOOK_AT).addScaledVector(way, far);
    this.controls.update();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(this.ratio);
    this.renderer.setSize(width, height, false);
    const before = this.camera.aspect;
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
    if (Math.abs(before - this.camera.aspect) > 0.05 && this.view) this.look(this.view);
  }

  /** @param {Record<string, string>} palette */
  paint(palette) {
    this.scene.background = new THREE.Color(palette['stage-far']);
    this.floor.paint(palette);
  }

  /** Whether the camera or the canvas is another than in the last picture. */
  hasMoved() {
    this.controls.update();
    this.camera.updateMatrixWorld();
    const mark = `${this.camera.matrixWorld.elements.map((x) => x.toFixed(4))}|${this.renderer.domElement.width}`;
    const moved = mark !== this.mark;
    this.mark = mark;
    return moved;
  }

  /** @param {number} spentMs between the last two frames */
  draw(spentMs) {
    this.#adapt(spentMs);
    this.renderer.render(this.scene, this.camera);
  }

  /** Draw fewer pixels where the machine cannot keep up, rather than fewer frames. */
  #adapt(spentMs) {
    if (spentMs > REST_MS) return;
    this.slow = 0.95 * this.slow + 0.05 * spentMs;
    if (this.slow > SLOW_MS && this.ratio > 0.81) {
      this.ratio = Math.max(0.8, this.ratio * 0.82);
      this.slow = 25;
      this.resize();
    }
  }

  /** Arrow keys turn the camera about the people, + and - come nearer and go away. */
  #steer(event) {
    const moves = {
      ArrowLeft: [-STEP, 0, 1], ArrowRight: [STEP, 0, 1], ArrowUp: [0, -STEP, 1],
      ArrowDown: [0, STEP, 1], '+': [0, 0, 0.92], '=': [0, 0, 0.92], '-': [0, 0, 1.08],
    };
    const move = moves[event.key];
    if (!move || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    event.stopPropagation();
    const way = this.camera.position.clone().sub(this.controls.target);
    const at = new THREE.Spherical().setFromVector3(way);
    at.theta += move[0];
    at.phi = Math.min(this.controls.maxPolarAngle, Math.max(0.05, at.phi + move[1]));
    at.radius = Math.min(14, Math.max(1.5, at.radius * move[2]));
    this.camera.position.setFromSpherical(at).add(this.controls.target);
  }
}
