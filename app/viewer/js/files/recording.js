import { readCsv } from './csv.js';
import { readMat } from './mat.js';
import { readNpz } from './npz.js';

/** Largest file that is read here; the service has a limit of its own for uploads. */
const MOST_BYTES = 64 * 1024 * 1024;
const LEAST_HZ = 1;
const MOST_HZ = 1000;
const FPS = 30;
const BREATH_S = 0.6;

/**
 * @typedef {{joints: number, action: string | null, rateHz: number, frames: Float32Array[]}} Clip
 *   frames are flat x, y, z per joint in metres, NaN where missing
 */

/**
 * Read a recording that was dropped onto the page.
 * @param {File} file
 * @param {{name: string, joints: {name: string}[]}} skeleton of the person, for `.csv`
 * @returns {Promise<Clip[]>}
 * @throws {Error} with a message for people
 */
export async function readRecording(file, skeleton) {
  if (file.size > MOST_BYTES) throw new Error(`${file.name} is larger than 64 MiB.`);
  const suffix = file.name.slice(file.name.lastIndexOf('.')).toLowerCase();
  const bytes = new Uint8Array(await file.arrayBuffer());
  const readers = {
    '.mat': () => readMat(bytes, file.name),
    '.npz': () => readNpz(bytes, file.name),
    '.csv': () => readCsv(readText(bytes, file.name), file.name, skeleton),
  };
  if (!readers[suffix]) throw new Error(`${file.name}: expected .mat, .npz or .csv.`);
  const clips = (await readers[suffix]()).filter((clip) => clip.frames.length);
  if (!clips.length) throw new Error(`${file.name} has no frames.`);
  const expected = skeleton.joints.length;
  if (clips.some((clip) => clip.joints !== expected)) {
    throw new Error(`${file.name} has ${clips[0].joints} joints, ${skeleton.name} has ${expected}.`);
  }
  if (!clips.every(({ rateHz }) => rateHz >= LEAST_HZ && rateHz <= MOST_HZ)) throw new Error(`${file.name}: its rate makes no sense.`);
  return clips;
}

function readText(bytes, name) {
  try {
    return new TextDecoder('utf-8', { fatal: true }).decode(bytes);
  } catch {
    throw new Error(`${name}: it is no text in UTF-8.`);
  }
}

/** A recording that is played over and over, with a breath without the person between clips. */
export class Player {
  /**
   * @param {string} name
   * @param {Clip[]} clips
   * @param {string} skeleton
   */
  constructor(name, clips, skeleton) {
    this.name = name;
    this.skeleton = skeleton;
    this.clips = clips.map((clip) => ({ ...clip, length: countFrames(clip) }));
    this.breath = Math.round(BREATH_S * FPS);
    this.total = this.clips.reduce((sum, clip) => sum + clip.length + this.breath, 0);
  }

  /**
   * @param {number} n frame, 30 a second
   * @returns {{joints: Float32Array | null, action: string | null}} null between clips
   */
  frame(n) {
    let at = n % this.total;
    for (const clip of this.clips) {
      if (at < clip.length) {
        return { joints: sampleClip(clip, at / FPS), action: clip.action };
      }
      at -= clip.length;
      if (at < this.breath) return { joints: null, action: null };
      at -= this.breath;
    }
    return { joints: null, action: null };
  }
}

function countFrames(clip) {
  return Math.max(1, Math.floor(((clip.frames.length - 1) / clip.rateHz) * FPS) + 1);
}

/** A pose at a time, linear between the frames around it. */
export function sampleClip(clip, t) {
  const place = Math.min(t * clip.rateHz, clip.frames.length - 1);
  const before = Math.floor(place + 1e-6);
  const share = place - before;
  const a = clip.frames[before];
  if (share < 1e-3 || before + 1 >= clip.frames.length) return a;
  const b = clip.frames[before + 1];
  return a.map((value, i) => value + (b[i] - value) * share);
}
