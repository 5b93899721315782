import * as THREE from 'three';

/** Puts bones between joints and balls about them; `places` are joints with their radii. */
const VERTEX = `
  uniform vec4 places[COUNT];
  uniform float fades[POSES];
  uniform float thick;
  uniform float head;
  attribute vec3 ends;
  varying float vFade;
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    vec4 a = places[int(ends.x)];
    vec4 b = places[int(ends.y)];
    vec3 at;
    if (ends.x == ends.y) {
      float isHead = float(ends.x == head);
      vNormal = position;
      at = a.xyz + a.w * position * mix(vec3(1.0), vec3(0.8, 1.0, 0.88), isHead);
    } else {
      vec3 along = normalize(b.xyz - a.xyz + vec3(0.0, 1e-6, 0.0));
      vec3 side = normalize(cross(along, abs(along.y) < 0.9 ? vec3(0, 1, 0) : vec3(1, 0, 0)));
      vNormal = side * position.x + cross(side, along) * position.y;
      float radius = thick > 0.0 ? thick : mix(a.w, b.w, position.z);
      at = mix(a.xyz, b.xyz, position.z) + radius * vNormal;
    }
    vFade = fades[int(ends.z)];
    vec4 world = modelMatrix * vec4(at, 1.0);
    vView = cameraPosition - world.xyz;
    gl_Position = projectionMatrix * viewMatrix * world;
    if (min(a.w, b.w) <= 0.0 || vFade <= 0.0) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  }`;

/** A matt body under a wide sky and a lamp. */
const SOLID = `
  uniform vec3 color;
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    vec3 n = normalize(vNormal);
    float sky = 0.5 + 0.5 * n.y;
    float lamp = max(0.0, dot(n, vec3(0.42, 0.64, -0.64)));
    float edge = 1.0 - max(0.0, dot(n, normalize(vView)));
    gl_FragColor = vec4(color * (0.62 + 0.26 * sky + 0.3 * lamp) + 0.1 * pow(edge, 3.0), 1.0);
    #include <colorspace_fragment>
  }`;

/** A flat body with a denser rim, so that it reads as round and hides nothing. */
const GHOST = `
  uniform vec3 color;
  uniform float opacity;
  uniform float rim;
  varying float vFade;
  varying vec3 vNormal;
  varying vec3 vView;
  void main() {
    float edge = 1.0 - abs(dot(normalize(vNormal), normalize(vView)));
    gl_FragColor = vec4(color, opacity * vFade * (1.0 - rim + rim * edge * edge));
    #include <colorspace_fragment>
  }`;

function make(fragmentShader, values, options) {
  return (count, poses) => new THREE.ShaderMaterial({
    vertexShader: VERTEX,
    fragmentShader,
    defines: { COUNT: count, POSES: poses },
    uniforms: {
      places: { value: [] }, fades: { value: [] }, color: { value: new THREE.Color() },
      thick: { value: 0 }, head: { value: -1 }, opacity: { value: 1 }, rim: { value: 0 },
      ...Object.fromEntries(Object.entries(values).map(([name, value]) => [name, { value }])),
    },
    ...options,
  });
}

/** The body that is seen now. */
export const solid = (thick, head) => make(SOLID, { thick, head }, {});

/** Something that is not there yet. */
export const ghost = (thick, opacity) => make(GHOST, { thick, opacity }, { transparent: true, depthWrite: false });

/** A translucent hull without seams where its parts overlap: this fills the depth first … */
export const hullDepth = () => make(GHOST, { opacity: 0 }, { colorWrite: false, transparent: true });

/** … and this colours what is nearest. */
export const hull = (opacity, rim) => make(GHOST, { opacity, rim }, {
  transparent: true, depthWrite: false, depthFunc: THREE.LessEqualDepth,
});

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
