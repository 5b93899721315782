/** Most bytes that one compressed piece may become: a small file can hold a very large array. */
const MOST_BYTES = 256 * 1024 * 1024;

/**
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {'deflate' | 'deflate-raw'} format with or without the header of zlib
 * @returns {Promise<Uint8Array<ArrayBuffer>>}
 */
export async function inflate(bytes, format) {
  const reader = new Blob([bytes]).stream().pipeThrough(new DecompressionStream(format)).getReader();
  const pieces = [];
  let length = 0;
  for (;;) {
    const { done, value } = await reader.read();
    if (done) break;
    length += value.length;
    if (length > MOST_BYTES) throw new Error('it unpacks to more than 256 MiB');
    pieces.push(value);
  }
  const whole = new Uint8Array(length);
  let at = 0;
  for (const piece of pieces) {
    whole.set(piece, at);
    at += piece.length;
  }
  return whole;
}
