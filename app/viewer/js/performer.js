import { Emitter } from './emitter.js';
import { FPS, HORIZONS, isAhead, scoreFrame } from './metrics.js';
import { Ring } from './ring.js';
import { Stream, now } from './stream.js';
import { fromYUp } from './space.js';

export { FPS };
/** Seconds that can be looked back on. */
export const HISTORY_S = 30;
/** Forecasts may take as long as a frame; later is a missed deadline. */
export const DEADLINE_MS = 1000 / FPS;
/** Frames that are sent at once after the page was held up; older ones are left out. */
const CATCH_UP = 14;
/** Errors after which there is no recording; others leave it waiting. */
const ENDS_TRIAL = new Set(['unknown_trial', 'trial_conflict', 'forbidden']);

/**
 * @typedef {Object} Moment one frame, and what was said from it
 * @property {number} seq
 * @property {number} n frame of the source
 * @property {number} t seconds on the clock of the stream
 * @property {Float32Array | null} joints metres, as sent
 * @property {string | null} action
 * @property {any} personal the forecast of what is active
 * @property {any} base the same by the base
 * @property {number} latencyMs from sending to the forecast, NaN until it came
 * @property {{zero: number, base: number, personal: number}[]} errors per horizon, millimetres
 */

/**
 * Plays a source at 30 Hz through the real stream of one person, and remembers what came.
 *
 * While a personal version is active, a second stream pinned to the base answers the same frames.
 * Tells `change`, `recording`, `job`, `version`, `trouble`.
 */
export class Performer extends Emitter {
  #personal;
  #base = null;
  #began = 0;
  #sent = 0;
  #options;
  #action = null;

  /**
   * @param {{url: URL, key: () => string, user: any, skeleton: any, source: any}} options
   */
  constructor(options) {
    super();
    this.#options = options;
    this.user = options.user;
    this.skeleton = options.skeleton;
    this.source = options.source;
    /** @type {Ring<Moment>} */
    this.history = new Ring(HISTORY_S * FPS);
    this.seq = 0;
    this.misses = 0;
    this.answers = 0;
    this.recording = null;
    this.waiting = '';
    this.version = options.user.version ?? null;
    this.#personal = this.#connect('active', 'personal');
  }

  get state() { return this.#personal.state; }
  get reason() { return this.#personal.reason; }
  get isPersonal() { return this.version?.kind === 'personal'; }

  start() {
    this.#began = now();
    this.#sent = 0;
    this.#personal.open();
    this.#matchBase();
  }

  stop() {
    this.#personal.close();
    this.#base?.close();
    this.#base = null;
  }

  /** Play something else to the same person. */
  play(source) {
    this.source = source;
    this.#began = now();
    this.#sent = 0;
  }

  /** Send what is due by now. */
  tick() {
    const due = Math.floor((now() - this.#began) * FPS);
    if (due - this.#sent > CATCH_UP) this.#sent = due - 1;
    while (this.#sent < due) this.#send(this.#sent++);
  }

  /**
   * Record what is streamed from now on; false where there is no connection.
   * @param {string} label
   */
  startTrial(label) {
    const trial = crypto.randomUUID?.() ?? makeUuid();
    if (this.recording || !this.#personal.send({ type: 'trial.start', trial, label })) return false;
    this.recording = { trial, state: 'starting', since: now(), frames: 0 };
    this.#action = null;
    this.emit('recording');
    return true;
  }

  /** @param {boolean} finetune */
  stopTrial(finetune) {
    this.#endTrial({ type: 'trial.stop', finetune });
  }

  cancelTrial() {
    this.#endTrial({ type: 'trial.cancel' });
  }

  /** How it ends is said now, and again where the link breaks before the service has heard it. */
  #endTrial(ending) {
    if (!this.recording) return;
    this.recording = { ...this.recording, state: 'storing', ending };
    this.#personal.send(ending);
    this.emit('recording');
  }

  #send(n) {
    const { joints, action } = this.source.frame(n);
    const t = this.#began + n / FPS;
    const turned = joints && (this.source.isYUp ? fromYUp(joints, this.user.up) : joints);
    const seq = this.seq++;
    if (this.recording?.state === 'recording') this.#nameClip(action);
    const moment = {
      seq, n, t, joints: turned, action, sentAt: now(), personal: null, base: null, latencyMs: NaN,
      errors: HORIZONS.map((ahead) => scoreFrame(turned, this.#past(seq, t, ahead), ahead)),
    };
    this.history.push(moment);
    this.#personal.frame(seq, t, turned);
    this.#base?.frame(seq, t, turned);
  }

  /** The moment that many frames before; none where the page was held up in between. */
  #past(seq, t, ahead) {
    const past = this.history.get(seq - ahead);
    return past && isAhead(t, past.t, ahead) ? past : undefined;
  }

  /** What is being done becomes the name of the clip. */
  #nameClip(action) {
    this.recording.frames += 1;
    if (!action || action === this.#action) return;
    if (this.#personal.send({ type: 'clip.start', action })) this.#action = action;
  }

  #connect(version, kind) {
    const { url, key } = this.#options;
    const stream = new Stream({ url, key, user: this.user.id, version });
    stream.on('forecast', (forecast) => this.#keep(kind, forecast));
    if (kind === 'base') return stream;
    stream.on('state', ({ state }) => {
      if (state === 'closed') this.#dropTrial();
      this.emit('change');
    });
    stream.on('hello', (hello) => {
      this.#resumeTrial();
      this.#follow(hello.version);
    });
    stream.on('version', (message) => {
      this.#follow(message.version);
      this.emit('version', message);
    });
    stream.on('waiting', (message) => { this.waiting = message.reason; });
    stream.on('trial', (message) => this.#hearTrial(message));
    stream.on('job', (message) => this.emit('job', message));
    stream.on('error', (message) => this.#hearError(message));
    return stream;
  }

  #follow(version) {
    this.version = version;
    this.#matchBase();
    this.emit('change');
  }

  /** A stream of the base is needed only where something else is active. */
  #matchBase() {
    if (this.isPersonal && !this.#base) {
      this.#base = this.#connect('base', 'base');
      this.#base.open();
    } else if (!this.isPersonal && this.#base) {
      this.#base.close();
      this.#base = null;
    }
  }

  #keep(kind, forecast) {
    const moment = this.history.get(forecast.seq);
    if (!moment || moment.seq !== forecast.seq) return;
    if (kind === 'base') {
      moment.base = forecast;
      return;
    }
    moment.personal = forecast;
    if (forecast.version.kind === 'base') moment.base = forecast;
    moment.latencyMs = 1000 * (now() - moment.sentAt);
    this.answers += 1;
    this.waiting = '';
    if (moment.latencyMs > DEADLINE_MS) this.misses += 1;
  }

  /** The stream has ended for good; the service stores what it has of the recording by itself. */
  #dropTrial() {
    if (!this.recording) return;
    this.recording = null;
    this.emit('recording');
  }

  /** On a new connection a recording goes on, in a clip of its own; one that never began is answered by an error. */
  #resumeTrial() {
    if (!this.recording) return;
    this.#action = null;
    this.#personal.send({ type: 'trial.resume', trial: this.recording.trial });
    if (this.recording.ending) this.#personal.send(this.recording.ending);
  }

  #hearTrial(message) {
    const ended = message.state !== 'recording';
    const state = this.recording?.ending ? 'storing' : message.state;
    this.recording = ended ? null : { ...this.recording, ...message, state };
    this.emit('recording', message);
  }

  /** Tell of an error; one that ends the recording, or keeps it from beginning, ends it here. */
  #hearError(message) {
    const waits = message.code === 'trial_unavailable';
    const isRefused = this.recording?.state === 'starting' && message.seq == null && !waits;
    if (this.recording && (isRefused || ENDS_TRIAL.has(message.code))) {
      this.recording = null;
      this.emit('recording');
    }
    this.emit('trouble', message);
  }
}

/** Where the page is not served securely, browsers keep `randomUUID` from it. */
function makeUuid() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  bytes[6] = (bytes[6] & 0x0f) | 0x40;
  bytes[8] = (bytes[8] & 0x3f) | 0x80;
  const hex = [...bytes].map((byte) => byte.toString(16).padStart(2, '0')).join('');
  return hex.replace(/^(.{8})(.{4})(.{4})(.{4})/, '$1-$2-$3-$4-');
}
