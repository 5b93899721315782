/** MATLAB's version 5 files, as far as UTD-MHAD needs them: the numeric array `d_skel`. */
import { inflate } from './inflate.js';

const MATRIX = 14;
const COMPRESSED = 15;
const JOINTS = 20;
const FPS = 30;
/** Readers of the number types in which MATLAB stores arrays, by their codes. */
const NUMBERS = {
  1: [1, 'getInt8'], 2: [1, 'getUint8'], 3: [2, 'getInt16'], 4: [2, 'getUint16'],
  5: [4, 'getInt32'], 6: [4, 'getUint32'], 7: [4, 'getFloat32'], 9: [8, 'getFloat64'],
};

/**
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {string} name of the file; `a8_s2_t1_skeleton.mat` names its action
 * @returns {Promise<import('./recording.js').Clip[]>} one clip
 * @throws {Error} it is no such file
 */
export async function readMat(bytes, name) {
  const view = viewOf(bytes);
  if (bytes.length < 136 || view.getUint16(126, true) !== 0x4d49) {
    throw new Error(`${name}: no MATLAB file of version 5.`);
  }
  try {
    for (const element of elementsOf(bytes, 128)) {
      const found = await findSkeleton(element);
      if (found) return [toClip(found, name)];
    }
  } catch (error) {
    throw new Error(`${name}: it cannot be read: ${error.message}.`, { cause: error });
  }
  throw new Error(`${name}: it has no variable d_skel of shape [20, 3, frames].`);
}

async function findSkeleton({ type, body }) {
  const inner = type === COMPRESSED
    ? elementsOf(await inflate(body, 'deflate'), 0)[0]
    : { type, body };
  if (inner?.type !== MATRIX) return null;
  const [, dimensions, label, data] = elementsOf(inner.body, 0);
  if (!data || new TextDecoder().decode(label.body) !== 'd_skel') return null;
  const shape = readNumbers(dimensions);
  if (shape.length !== 3 || shape[0] !== JOINTS || shape[1] !== 3) return null;
  const values = readNumbers(data);
  if (values.length !== shape[0] * shape[1] * shape[2]) throw new Error('it ends too early');
  return { values, frames: shape[2] };
}

/** The elements one after another; short ones keep their data within the tag. */
function elementsOf(bytes, begin) {
  const view = viewOf(bytes);
  const elements = [];
  for (let at = begin; at + 8 <= bytes.length; ) {
    const word = view.getUint32(at, true);
    if (word >>> 16) {
      elements.push({ type: word & 0xffff, body: bytes.subarray(at + 4, at + 4 + (word >>> 16)) });
      at += 8;
      continue;
    }
    const size = view.getUint32(at + 4, true);
    if (at + 8 + size > bytes.length) throw new Error('it ends too early');
    elements.push({ type: word, body: bytes.subarray(at + 8, at + 8 + size) });
    at += 8 + (word === COMPRESSED ? size : Math.ceil(size / 8) * 8);
  }
  return elements;
}

function readNumbers({ type, body }) {
  const kind = NUMBERS[type];
  if (!kind) throw new Error(`numbers of an unknown type ${type}`);
  const [size, method] = kind;
  const view = viewOf(body);
  return Array.from({ length: Math.floor(body.length / size) }, (_, i) => view[method](i * size, true));
}

/** Arrays of MATLAB vary the first index fastest: joint, then axis, then frame. */
function toClip({ values, frames }, name) {
  const poses = Array.from({ length: frames }, (_, t) =>
    Float32Array.from({ length: 3 * JOINTS }, (_, i) => {
      const [joint, axis] = [Math.floor(i / 3), i % 3];
      return values[joint + JOINTS * (axis + 3 * t)];
    }),
  );
  const action = /^a(\d+)_s\d+_t\d+/.exec(name)?.[1] ?? name.replace(/\.mat$/i, '');
  return { joints: JOINTS, action, rateHz: FPS, frames: poses };
}

function viewOf(bytes) {
  return new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
}
