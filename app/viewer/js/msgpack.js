/** MessagePack, as far as the stream needs it. https://github.com/msgpack/msgpack/blob/master/spec.md */

const text = { encode: new TextEncoder(), decode: new TextDecoder('utf-8', { fatal: true }) };

/**
 * Bytes of floats for a field of a frame: float32, little-endian.
 * @param {Float32Array} values
 */
export function packFloats(values) {
  return new Uint8Array(values.buffer, values.byteOffset, values.byteLength);
}

/**
 * @param {any} value null, booleans, numbers, strings, bytes, arrays and plain objects
 * @returns {Uint8Array<ArrayBuffer>}
 */
export function encode(value) {
  const out = new Writer();
  out.write(value);
  return out.bytes.slice(0, out.length);
}

/**
 * @param {ArrayBuffer | Uint8Array} data one value
 * @returns {any} bytes come as `Uint8Array`, a copy of their own
 * @throws {RangeError} where it ends too early or has an unknown type
 */
export function decode(data) {
  return new Reader(data instanceof Uint8Array ? data : new Uint8Array(data)).read();
}

class Writer {
  constructor() {
    this.bytes = new Uint8Array(512);
    this.view = new DataView(this.bytes.buffer);
    this.length = 0;
  }

  #grow(more) {
    if (this.length + more <= this.bytes.length) return;
    const larger = new Uint8Array(Math.max(this.length + more, 2 * this.bytes.length));
    larger.set(this.bytes);
    this.bytes = larger;
    this.view = new DataView(larger.buffer);
  }

  #byte(value) {
    this.#grow(1);
    this.bytes[this.length++] = value;
  }

  #raw(bytes) {
    this.#grow(bytes.length);
    this.bytes.set(bytes, this.length);
    this.length += bytes.length;
  }

  /** A type byte and a length, in the shortest of the given forms. */
  #head(length, fixed, fixedMax, forms) {
    if (length <= fixedMax) return this.#byte(fixed | length);
    const [code, size] = forms.find(([, size]) => length < 2 ** (8 * size));
    this.#byte(code);
    this.#grow(size);
    if (size === 1) this.view.setUint8(this.length, length);
    else if (size === 2) this.view.setUint16(this.length, length);
    else this.view.setUint32(this.length, length);
    this.length += size;
  }

  write(value) {
    if (value === null || value === undefined) this.#byte(0xc0);
    else if (value === false || value === true) this.#byte(value ? 0xc3 : 0xc2);
    else if (typeof value === 'number') this.#number(value);
    else if (typeof value === 'string') this.#string(value);
    else if (value instanceof Uint8Array) this.#binary(value);
    else if (Array.isArray(value)) this.#array(value);
    else this.#object(value);
  }

  #number(value) {
    if (Number.isSafeInteger(value) && value >= 0 && value < 2 ** 32) {
      this.#head(value, 0, 0x7f, [[0xcc, 1], [0xcd, 2], [0xce, 4]]);
    } else if (Number.isSafeInteger(value)) {
      this.#byte(value < 0 ? 0xd3 : 0xcf);
      this.#grow(8);
      this.view.setBigInt64(this.length, BigInt(value));
      this.length += 8;
    } else {
      this.#byte(0xcb);
      this.#grow(8);
      this.view.setFloat64(this.length, value);
      this.length += 8;
    }
  }

  #string(value) {
    const bytes = text.encode.encode(value);
    this.#head(bytes.length, 0xa0, 31, [[0xd9, 1], [0xda, 2], [0xdb, 4]]);
    this.#raw(bytes);
  }

  #binary(value) {
    this.#head(value.length, 0, -1, [[0xc4, 1], [0xc5, 2], [0xc6, 4]]);
    this.#raw(value);
  }

  #array(value) {
    this.#head(value.length, 0x90, 15, [[0xdc, 2], [0xdd, 4]]);
    for (const item of value) this.write(item);
  }

  #object(value) {
    const entries = Object.entries(value).filter(([, item]) => item !== undefined);
    this.#head(entries.length, 0x80, 15, [[0xde, 2], [0xdf, 4]]);
    for (const [key, item] of entries) {
      this.#string(key);
      this.write(item);
    }
  }
}

class Reader {
  constructor(bytes) {
    this.bytes = bytes;
    this.view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    this.at = 0;
  }

  #take(size, read) {
    const value = read(this.at);
    this.at += size;
    return value;
  }

  #length(size) {
    if (size === 1) return this.#take(1, (at) => this.view.getUint8(at));
    if (size === 2) return this.#take(2, (at) => this.view.getUint16(at));
    return this.#take(4, (at) => this.view.getUint32(at));
  }

  #slice(length) {
    if (this.at + length > this.bytes.length) throw new RangeError('the message ends too early');
    this.at += length;
    return this.bytes.slice(this.at - length, this.at);
  }

  #string(length) {
    return text.decode.decode(this.#slice(length));
  }

  #array(length) {
    return Array.from({ length }, () => this.read());
  }

  #object(length) {
    const found = {};
    for (let i = 0; i < length; i++) {
      const key = String(this.read());
      Object.defineProperty(found, key, {
        value: this.read(), enumerable: true, writable: true, configurable: true,
      });
    }
    return found;
  }

  read() {
    const code = this.#length(1);
    if (code <= 0x7f) return code;
    if (code <= 0x8f) return this.#object(code & 0x0f);
    if (code <= 0x9f) return this.#array(code & 0x0f);
    if (code <= 0xbf) return this.#string(code & 0x1f);
    if (code >= 0xe0) return code - 0x100;
    return this.#readLong(code);
  }

  #readLong(code) {
    const { view } = this;
    switch (code) {
      case 0xc0: return null;
      case 0xc2: return false;
      case 0xc3: return true;
      case 0xc4: case 0xc5: case 0xc6: return this.#slice(this.#length(1 << (code - 0xc4)));
      case 0xca: return this.#take(4, (at) => view.getFloat32(at));
      case 0xcb: return this.#take(8, (at) => view.getFloat64(at));
      case 0xcc: case 0xcd: case 0xce: return this.#length(1 << (code - 0xcc));
      case 0xcf: return Number(this.#take(8, (at) => view.getBigUint64(at)));
      case 0xd0: return this.#take(1, (at) => view.getInt8(at));
      case 0xd1: return this.#take(2, (at) => view.getInt16(at));
      case 0xd2: return this.#take(4, (at) => view.getInt32(at));
      case 0xd3: return Number(this.#take(8, (at) => view.getBigInt64(at)));
      case 0xd9: case 0xda: case 0xdb: return this.#string(this.#length(1 << (code - 0xd9)));
      case 0xdc: case 0xdd: return this.#array(this.#length(2 << (code - 0xdc)));
      case 0xde: case 0xdf: return this.#object(this.#length(2 << (code - 0xde)));
      default: throw new RangeError(`unknown type 0x${code.toString(16)}`);
    }
  }
}
