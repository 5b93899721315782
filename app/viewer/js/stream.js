import { Emitter } from './emitter.js';
import { decode, encode, packFloats } from './msgpack.js';

const PROTOCOL = 'kinecast.v1.msgpack';
/** Seconds of frames that fill the window of a new connection. */
const REPLAY_S = 0.6;
const BACK_OFF_S = { first: 0.1, most: 5 };
/** A connection that lasted this long was a good one. */
const SETTLED_S = 5;
/** Frames without a word from the service, three seconds of them: the link is dead. */
const SILENT_FRAMES = 90;
/** Bytes that may wait in the browser; more would only make frames old. */
const MOST_WAITING = 65_536;
/** Close codes after which coming back makes no sense without somebody's help. */
const FINAL = new Set([4400, 4401, 4403, 4404, 4406, 4409, 4410, 4413]);

/** The clock of the frames, in seconds; it only ever goes forward. */
export const now = () => performance.now() / 1000;

/**
 * One stream of one person, which comes back by itself.
 *
 * Tells `state` (connecting, open, waiting, closed), `hello`, `forecast` with its arrays as typed
 * arrays, and every other message under its own type.
 */
export class Stream extends Emitter {
  #socket = null;
  #recent = [];
  #failures = 0;
  #openedAt = Infinity;
  #timer = 0;
  #fatal = '';
  #retryAfter = 0;
  #unanswered = 0;

  /**
   * @param {{url: URL, key: () => string, user: string, version?: string}} options
   */
  constructor({ url, key, user, version = 'active' }) {
    super();
    this.options = { url, key, user, version };
    this.session = `viewer-${crypto.getRandomValues(new Uint32Array(2)).join('-')}`;
    this.state = 'closed';
    this.reason = '';
  }

  open() {
    clearTimeout(this.#timer);
    const { url, user, version } = this.options;
    const target = new URL(`v1/users/${encodeURIComponent(user)}/stream`, url);
    target.protocol = url.protocol === 'https:' ? 'wss:' : 'ws:';
    target.search = new URLSearchParams({ session: this.session, version }).toString();
    this.#set('connecting');
    const socket = new WebSocket(target, [PROTOCOL]);
    socket.binaryType = 'arraybuffer';
    this.#socket = socket;
    socket.onopen = () => this.#write({ type: 'auth', key: this.options.key() });
    socket.onmessage = (event) => this.#hear(event.data);
    socket.onclose = (event) => this.#lose(socket, event.code);
  }

  close() {
    clearTimeout(this.#timer);
    const socket = this.#socket;
    this.#socket = null;
    this.#recent = [];
    if (socket) {
      socket.onmessage = null;
      socket.onclose = null;
      socket.close(1000);
    }
    this.#set('closed');
  }

  /**
   * Send a frame; where there is no connection it only waits to fill the next window.
   * @param {number} seq
   * @param {number} t seconds
   * @param {Float32Array | null} joints
   */
  frame(seq, t, joints) {
    const message = { type: 'frame', seq, t, joints: joints && packFloats(joints) };
    this.#recent.push(message);
    while (this.#recent[0].t < t - REPLAY_S) this.#recent.shift();
    if (this.state !== 'open') return;
    this.#unanswered += 1;
    if (this.#unanswered > SILENT_FRAMES) this.#giveUp();
    else if (!(this.#socket?.bufferedAmount > MOST_WAITING)) this.#write(message);
  }

  /**
   * Send another message; false where there is no connection.
   * @param {Record<string, any>} message
   */
  send(message) {
    if (this.state !== 'open') return false;
    this.#write(message);
    return true;
  }

  #write(message) {
    if (this.#socket?.readyState === WebSocket.OPEN) this.#socket.send(encode(message));
  }

  #set(state, reason = '') {
    this.state = state;
    this.reason = reason;
    this.emit('state', { state, reason });
  }

  #hear(data) {
    this.#unanswered = 0;
    const message = decode(data);
    if (message.type === 'hello') this.#greet(message);
    else if (message.type === 'forecast') this.emit('forecast', readForecast(message));
    else if (message.type === 'ping') this.#write({ ...message, type: 'pong', t: now() });
    else if (message.type === 'bye') this.#retryAfter = message.retry_after_s || 0;
    else if (message.type === 'error') this.#complain(message);
    else this.emit(message.type, message);
  }

  #greet(message) {
    this.#openedAt = now();
    this.#fatal = '';
    for (const frame of this.#recent) this.#write({ ...frame, replay: true });
    this.#set('open');
    this.emit('hello', message);
  }

  #complain(message) {
    this.#fatal = message.message;
    this.emit('error', message);
  }

  #giveUp() {
    const socket = this.#socket;
    socket.onmessage = null;
    socket.onclose = null;
    socket.close();
    this.#fatal = 'the service is silent';
    this.#lose(socket, 1006);
  }

  #lose(socket, code) {
    if (socket !== this.#socket) return;
    this.#socket = null;
    if (FINAL.has(code)) {
      this.#set('closed', this.#fatal || `closed with code ${code}`);
      return;
    }
    if (now() - this.#openedAt >= SETTLED_S) this.#failures = 0;
    this.#openedAt = Infinity;
    const most = Math.min(BACK_OFF_S.most, BACK_OFF_S.first * 2 ** this.#failures++);
    const wait = Math.max(this.#retryAfter, most * (0.5 + Math.random() / 2));
    this.#retryAfter = 0;
    this.#set('waiting', this.#fatal);
    this.#timer = setTimeout(() => this.open(), 1000 * wait);
  }
}

/** Turn the bytes of a forecast into numbers. */
function readForecast(message) {
  const { frames, radius, t_out: times } = message;
  return {
    ...message,
    frames: new Float32Array(frames.buffer),
    radius: radius && new Float32Array(radius.buffer),
    t_out: new Float64Array(times.buffer),
  };
}
