import * as THREE from 'three';

const VERTEX = `
  attribute float fade;
  varying float vFade;
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    mat4 world = modelViewMatrix * instanceMatrix;
    vec4 at = world * vec4(position, 1.0);
    vFade = fade;
    vNormal = normalize(mat3(world) * normal);
    vView = normalize(-at.xyz);
    gl_Position = projectionMatrix * at;
  }`;

/** A flat body with a brighter rim, so that what is within still reads as round. */
const FRAGMENT = `
  uniform vec3 color;
  uniform float opacity;
  uniform float rim;
  varying float vFade;
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    float edge = 1.0 - abs(dot(normalize(vNormal), vView));
    gl_FragColor = vec4(color, opacity * vFade * (1.0 - rim + rim * edge * edge));
    #include <colorspace_fragment>
  }`;

/** The body that is seen now. */
export function makeSolid() {
  return new THREE.MeshLambertMaterial({ color: 0xffffff });
}

/**
 * Something that is not there yet.
 * @param {number} opacity
 * @param {number} [rim] how much of it is only at the edge
 */
export function makeGhost(opacity, rim = 0) {
  return new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    uniforms: {
      color: { value: new THREE.Color() }, opacity: { value: opacity }, rim: { value: rim },
    },
    transparent: true,
    depthWrite: false,
  });
}

/** A translucent body without seams where its parts overlap: depth first, then what is nearest. */
export function makeShell(opacity, rim) {
  const depth = makeGhost(0);
  depth.colorWrite = false;
  depth.depthWrite = true;
  const colour = makeGhost(opacity, rim);
  colour.depthFunc = THREE.LessEqualDepth;
  return { depth, colour };
}

/** A soft dark spot where somebody touches the floor. */
export function makeShadow() {
  const canvas = document.createElement('canvas');
  canvas.width = canvas.height = 64;
  const context = canvas.getContext('2d');
  const gradient = context.createRadialGradient(32, 32, 0, 32, 32, 32);
  gradient.addColorStop(0, 'rgba(0,0,0,0.75)');
  gradient.addColorStop(0.45, 'rgba(0,0,0,0.28)');
  gradient.addColorStop(1, 'rgba(0,0,0,0)');
  context.fillStyle = gradient;
  context.fillRect(0, 0, 64, 64);
  return new THREE.MeshBasicMaterial({
    map: new THREE.CanvasTexture(canvas), transparent: true, depthWrite: false, opacity: 0.5,
  });
}
