import * as THREE from 'three';

const VERTEX = `
  varying vec3 vAt;
  void main() {
    vec4 world = modelMatrix * vec4(position, 1.0);
    vAt = world.xyz;
    gl_Position = projectionMatrix * viewMatrix * world;
  }`;

/** Lines every half metre, stronger every metre, that fade into the distance. */
const FRAGMENT = `
  uniform vec3 near;
  uniform vec3 far;
  uniform vec3 ink;
  varying vec3 vAt;
  float lines(float cell) {
    vec2 at = vAt.xz / cell;
    vec2 wide = fwidth(at);
    vec2 off = abs(fract(at - 0.5) - 0.5) / max(wide, 1e-4);
    return (1.0 - min(min(off.x, off.y), 1.0)) * (1.0 - smoothstep(0.25, 0.6, max(wide.x, wide.y)));
  }
  void main() {
    float away = smoothstep(1.5, 8.5, length(vAt.xz));
    float line = max(0.42 * lines(1.0), 0.14 * lines(0.5));
    gl_FragColor = vec4(mix(mix(near, ink, line * (1.0 - away)), far, away), 1.0);
    #include <colorspace_fragment>
  }`;

/** The floor, with a grid of which one can read distances. */
export class Floor {
  constructor() {
    this.uniforms = Object.fromEntries(['near', 'far', 'ink'].map((name) => [name, { value: new THREE.Color() }]));
    this.mesh = new THREE.Mesh(
      new THREE.CircleGeometry(9, 40).rotateX(-Math.PI / 2),
      new THREE.ShaderMaterial({ vertexShader: VERTEX, fragmentShader: FRAGMENT, uniforms: this.uniforms, depthWrite: false }),
    );
    this.mesh.renderOrder = -3;
  }

  /** @param {Record<string, string>} palette */
  paint(palette) {
    this.uniforms.near.value.set(palette.stage);
    this.uniforms.far.value.set(palette['stage-far']);
    this.uniforms.ink.value.set(palette.grid);
  }
}
