/** Arrays of numpy in a zip: `frames`, `lengths`, `subject`, `action`, `trial`, `rate_hz`. */
import { inflate } from './inflate.js';

const KEYS = ['frames', 'lengths', 'action', 'rate_hz'];
const END = 0x06054b50;
const ENTRY = 0x02014b50;
const COMMENT_MOST = 65_557;
const TYPES = {
  '<f4': [4, 'getFloat32'], '<f8': [8, 'getFloat64'], '<i4': [4, 'getInt32'],
  '<i2': [2, 'getInt16'], '<u2': [2, 'getUint16'], '<u4': [4, 'getUint32'], '|i1': [1, 'getInt8'],
  '|u1': [1, 'getUint8'],
};

/**
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {string} name
 * @returns {Promise<import('./recording.js').Clip[]>}
 * @throws {Error} it is no such file
 */
export async function readNpz(bytes, name) {
  try {
    const members = listMembers(bytes);
    const arrays = {};
    for (const key of KEYS) {
      const member = members.get(`${key}.npy`);
      if (!member) throw new Error(`it lacks ${key}`);
      arrays[key] = readNpy(await unpack(bytes, member));
    }
    return cut(arrays);
  } catch (error) {
    throw new Error(`${name}: it cannot be read: ${error.message}.`, { cause: error });
  }
}

function cut({ frames, lengths, action, rate_hz: rate }) {
  const [count, joints, axes] = frames.shape;
  if (frames.shape.length !== 3 || axes !== 3 || joints < 1) throw new Error('frames must have the shape [N, J, 3]');
  if (!lengths.values.every((length) => Number.isInteger(length) && length >= 0)) throw new Error('lengths must be whole numbers');
  const total = lengths.values.reduce((sum, length) => sum + length, 0);
  if (total !== count) throw new Error(`lengths add up to ${total}, but there are ${count} frames`);
  let at = 0;
  return lengths.values.map((length, i) => {
    const poses = Array.from({ length }, (_, t) => {
      const from = (at + t) * joints * 3;
      return Float32Array.from(frames.values.slice(from, from + joints * 3));
    });
    at += length;
    return { joints, action: action.values[i] || null, rateHz: rate.values[0], frames: poses };
  });
}

/** Read the directory at the end of a zip. */
function listMembers(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  let end = bytes.length - 22;
  while (end >= 0 && end > bytes.length - COMMENT_MOST && view.getUint32(end, true) !== END) end--;
  if (end < 0 || view.getUint32(end, true) !== END) throw new Error('it is no zip');
  const members = new Map();
  let at = view.getUint32(end + 16, true);
  for (let i = view.getUint16(end + 10, true); i > 0; i--) {
    if (view.getUint32(at, true) !== ENTRY) throw new Error('its directory is damaged');
    const sizes = [28, 30, 32].map((offset) => view.getUint16(at + offset, true));
    const label = new TextDecoder().decode(bytes.subarray(at + 46, at + 46 + sizes[0]));
    members.set(label, {
      method: view.getUint16(at + 10, true),
      size: view.getUint32(at + 20, true),
      offset: view.getUint32(at + 42, true),
    });
    at += 46 + sizes[0] + sizes[1] + sizes[2];
  }
  return members;
}

async function unpack(bytes, { method, size, offset }) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  const begin = offset + 30 + view.getUint16(offset + 26, true) + view.getUint16(offset + 28, true);
  const body = bytes.subarray(begin, begin + size);
  if (method === 0) return body;
  if (method === 8) return inflate(body, 'deflate-raw');
  throw new Error(`it is packed by an unknown method ${method}`);
}

/** Read one array; its header is the text of a Python dictionary. */
export function readNpy(bytes) {
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
  if (view.getUint32(0) !== 0x934e554d) throw new Error('a member is no array');
  const wide = bytes[6] >= 2;
  const begin = (wide ? 12 : 10) + (wide ? view.getUint32(8, true) : view.getUint16(8, true));
  const header = new TextDecoder('latin1').decode(bytes.subarray(10, begin));
  const kind = /'descr':\s*'([^']+)'/.exec(header)?.[1] ?? '';
  const shape = (/'shape':\s*\(([^)]*)\)/.exec(header)?.[1] ?? '')
    .split(',').filter((part) => part.trim()).map(Number);
  if (!shape.every((size) => Number.isInteger(size) && size >= 0)) throw new Error('an array has no shape');
  const count = shape.reduce((product, size) => product * size, 1);
  const values = readValues(view, begin, kind, count);
  return { shape, values: /'fortran_order':\s*True/.test(header) ? toRows(values, shape) : values };
}

/** Values whose first index varies fastest, in the order in which the last one does. */
function toRows(values, shape) {
  const strides = shape.map((_, axis) => shape.slice(0, axis).reduce((product, size) => product * size, 1));
  return values.map((_, i) => {
    let place = 0;
    for (let axis = shape.length - 1, left = i; axis >= 0; axis--) {
      place += (left % shape[axis]) * strides[axis];
      left = Math.floor(left / shape[axis]);
    }
    return values[place];
  });
}

/** A number of half precision, IEEE 754. */
function readHalf(view, at) {
  const bits = view.getUint16(at, true);
  const [sign, exponent, fraction] = [bits >> 15 ? -1 : 1, (bits >> 10) & 31, bits & 1023];
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -14 * (fraction / 1024));
}

function readValues(view, begin, kind, count) {
  const check = (size) => {
    if (!(size >= 1) || begin + size * count > view.byteLength) throw new Error('an array ends too early');
  };
  if (kind.startsWith('<U')) {
    const width = 4 * Number(kind.slice(2));
    check(width);
    return Array.from({ length: count }, (_, i) => readText(view, begin + i * width, width));
  }
  if (kind === '<i8' || kind === '<u8') {
    check(8);
    return Array.from({ length: count }, (_, i) => Number(view.getBigInt64(begin + 8 * i, true)));
  }
  if (kind === '<f2') {
    check(2);
    return Array.from({ length: count }, (_, i) => readHalf(view, begin + 2 * i));
  }
  if (!TYPES[kind]) throw new Error(`an array has the type ${kind}`);
  const [size, method] = TYPES[kind];
  check(size);
  return Array.from({ length: count }, (_, i) => view[method](begin + i * size, true));
}

function readText(view, begin, width) {
  let text = '';
  for (let at = begin; at < begin + width; at += 4) {
    const point = view.getUint32(at, true);
    if (point) text += String.fromCodePoint(point);
  }
  return text;
}
