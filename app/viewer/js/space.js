/** Frames of reference: the scene has y up; sensors may have y, -y or z. All are right-handed. */

/** For each `up`: which coordinate becomes x, y, z, and its sign. */
const TO_Y_UP = {
  y: [[0, 1, 2], [1, 1, 1]],
  '-y': [[0, 1, 2], [-1, -1, 1]],
  z: [[1, 2, 0], [1, 1, 1]],
};

/**
 * Turn poses from a frame with `up` into one with y up; nothing is mirrored.
 * @param {Float32Array} poses flat x, y, z
 * @param {'y' | '-y' | 'z'} up
 */
export function toYUp(poses, up) {
  const [axes, signs] = TO_Y_UP[up] ?? TO_Y_UP.y;
  if (axes[0] === 0 && signs[0] === 1) return poses;
  const out = new Float32Array(poses.length);
  for (let i = 0; i < poses.length; i += 3) {
    for (let k = 0; k < 3; k++) out[i + k] = signs[k] * poses[i + axes[k]];
  }
  return out;
}

/** Undoes `toYUp`. */
export function fromYUp(poses, up) {
  const [axes, signs] = TO_Y_UP[up] ?? TO_Y_UP.y;
  if (axes[0] === 0 && signs[0] === 1) return poses;
  const out = new Float32Array(poses.length);
  for (let i = 0; i < poses.length; i += 3) {
    for (let k = 0; k < 3; k++) out[i + axes[k]] = signs[k] * poses[i + k];
  }
  return out;
}
