/** Parts of the viewer that need no browser. Run by tests/browser/test_modules.py, or by `node --test`. */
import assert from 'node:assert/strict';
import { readFileSync } from 'node:fs';
import { test } from 'node:test';

const js = new URL('../../../app/viewer/js/', import.meta.url);
const load = (name) => import(new URL(name, js));
const { Ring } = await load('ring.js');
const { decode, encode, packFloats } = await load('msgpack.js');
const { mean, meanErrorMm, quantile, scoreFrame, smooth } = await load('metrics.js');
const { fromYUp, toYUp } = await load('space.js');
const { readMat } = await load('files/mat.js');
const { readNpz } = await load('files/npz.js');
const { readCsv } = await load('files/csv.js');
const { Player, readRecording } = await load('files/recording.js');
const { SyntheticPerson } = await load('demo/person.js');
const { Performer } = await load('performer.js');
const { Stream } = await load('stream.js');
const { Api, LEFT } = await load('api.js');

const SKELETON = { name: 'two', joints: [{ name: 'head' }, { name: 'hip' }] };
const fixture = (name) => new Uint8Array(readFileSync(new URL(name, `file://${process.env.VIEWER_FIXTURES}/`)));
const expected = () => JSON.parse(new TextDecoder().decode(fixture('expected.json')));

test('a ring keeps the newest under their numbers', () => {
  const ring = new Ring(3);
  assert.equal(ring.last, undefined);
  for (const item of 'abcde') ring.push(item);
  assert.deepEqual(ring.toArray(), ['c', 'd', 'e']);
  assert.deepEqual([ring.get(1), ring.get(2), ring.get(4), ring.get(5)], [undefined, 'c', 'e', undefined]);
  assert.equal(ring.length, 3);
  ring.clear();
  assert.deepEqual(ring.toArray(), []);
  assert.throws(() => new Ring(0), RangeError);
});

test('messages come back as they went', () => {
  const long = 'ö'.repeat(300);
  const value = {
    type: 'frame', seq: 2 ** 40, t: 12.5, none: null, yes: true, no: false, text: long, small: -3,
    list: Array.from({ length: 20 }, (_, i) => i * 300), big: 70_000, nested: { a: { b: [] } },
  };
  assert.deepEqual(decode(encode(value)), value);
  assert.deepEqual(decode(encode(new Uint8Array(70_000).fill(7))), new Uint8Array(70_000).fill(7));
  assert.deepEqual(decode(encode({ gone: undefined })), {});
});

test('a frame has the bytes of the protocol', () => {
  const joints = packFloats(new Float32Array([0.1959, 0.5607, 2.5394]));
  const bytes = Buffer.from(encode({ type: 'frame', seq: 0, t: 12.5, joints })).toString('hex');
  assert.equal(bytes, '84a474797065a56672616d65a373657100a174cb4029000000000000a66a6f696e7473c40c029a483e098a0f3f88852240');
});

test('what no encoder of ours writes is read as well, and damage is refused', () => {
  assert.equal(decode(new Uint8Array([0xd1, 0xff, 0x00])), -256);
  assert.equal(decode(new Uint8Array([0xca, 0x3f, 0x80, 0, 0])), 1);
  assert.equal(decode(new Uint8Array([0xd0, 0x80])), -128);
  assert.deepEqual(decode(new Uint8Array([0xdc, 0, 2, 1, 2])), [1, 2]);
  assert.deepEqual(Object.keys(decode(encode({ ['__proto__x']: 1 }))), ['__proto__x']);
  assert.throws(() => decode(new Uint8Array([0xc4, 9, 1])), RangeError);
  assert.throws(() => decode(new Uint8Array([0xc1])), RangeError);
  assert.throws(() => decode(new Uint8Array([0xcd, 1])), RangeError);
});

test('errors are mean distances per joint in millimetres, of joints that both have', () => {
  const a = new Float32Array([0, 0, 0, 1, 1, 1]);
  assert.ok(Math.abs(meanErrorMm(a, new Float32Array([0.003, 0.004, 0, 1, 1, 1])) - 2.5) < 1e-3);
  assert.ok(Math.abs(meanErrorMm(a, new Float32Array([NaN, 0, 0, 1, 1, 1.01])) - 10) < 1e-3);
  assert.ok(Number.isNaN(meanErrorMm(a, new Float32Array(6).fill(NaN))));
});

test('a forecast is scored at the frame that it was for', () => {
  const pose = (x) => new Float32Array([x, 0, 0]);
  const forecast = (x) => ({ frames: Float32Array.from({ length: 45 }, (_, i) => (i < 42 ? 9 : i === 42 ? x : 0)) });
  const past = { joints: pose(0), base: forecast(0.09), personal: forecast(0.1) };
  const score = scoreFrame(pose(0.1), past, 15);
  assert.deepEqual(Object.values(score).map(Math.round), [100, 10, 0]);
  assert.ok(Object.values(scoreFrame(pose(1), undefined, 15)).every(Number.isNaN));
  assert.ok(Number.isNaN(scoreFrame(pose(1), { joints: pose(0), base: null, personal: null }, 15).base));
});

test('means and quantiles leave out what is not known', () => {
  assert.equal(mean([1, NaN, 3]), 2);
  assert.ok(Number.isNaN(mean([])));
  assert.equal(quantile([5, 1, NaN, 3, 4, 2], 0.5), 3);
  assert.equal(quantile([5, 1, 3, 4, 2], 0.99), 5);
  assert.deepEqual(smooth([1, 3, NaN, 5], 2), [1, 2, NaN, 5]);
});

test('frames of reference are turned, never mirrored', () => {
  const basis = new Float32Array([1, 0, 0, 0, 1, 0, 0, 0, 1]);
  for (const [up, axis] of [['y', [0, 1, 0]], ['-y', [0, -1, 0]], ['z', [0, 0, 1]]]) {
    assert.deepEqual([...toYUp(new Float32Array(axis), up)].map((x) => x + 0), [0, 1, 0]);
    const [a, b, c, d, e, f, g, h, i] = toYUp(basis, up);
    assert.equal(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g), 1);
    assert.deepEqual(fromYUp(toYUp(basis, up), up), basis);
  }
});

test('recordings of every kind are read', { skip: !process.env.VIEWER_FIXTURES && 'no VIEWER_FIXTURES' }, async () => {
  const poses = expected();
  const check = (clips, actions, slack = 1e-6) => {
    assert.deepEqual(clips.map((clip) => clip.action), actions);
    clips.flatMap((clip) => clip.frames).forEach((frame, t) => {
      frame.forEach((value, i) => assert.ok(Math.abs(value - poses[t][i]) < slack));
    });
    assert.equal(clips.reduce((sum, clip) => sum + clip.frames.length, 0), poses.length);
  };
  check(await readMat(fixture('packed.mat'), 'a8_s1_t2_skeleton.mat'), ['8']);
  check(await readMat(fixture('plain.mat'), 'other.mat'), ['other']);
  check(await readNpz(fixture('packed.npz'), 'packed.npz'), ['wave', 'walk']);
  check(await readNpz(fixture('plain.npz'), 'plain.npz'), ['wave', 'walk']);
  check(await readNpz(fixture('fortran.npz'), 'fortran.npz'), ['wave', 'walk']);
  check(await readNpz(fixture('half.npz'), 'half.npz'), ['wave', 'walk'], 2e-3);
});

test('damaged recordings are refused with their name', { skip: !process.env.VIEWER_FIXTURES && 'no VIEWER_FIXTURES' }, async () => {
  const mat = fixture('packed.mat');
  const npz = fixture('packed.npz');
  for (const damage of [new Uint8Array(4), mat.slice(0, 300), mat.slice(0, mat.length - 40)]) {
    await assert.rejects(readMat(damage, 'bad.mat'), /bad\.mat/);
  }
  for (const damage of [new Uint8Array(4), npz.slice(0, npz.length - 30), npz.slice(30)]) {
    await assert.rejects(readNpz(damage, 'bad.npz'), /bad\.npz/);
  }
  await assert.rejects(readMat(fixture('foreign.mat'), 'foreign.mat'), /d_skel/);
  await assert.rejects(readRecording(new File(['x'], 'a.txt'), SKELETON), /expected \.mat/);
});

test('a table is cut into clips, and an empty cell is a missing joint', () => {
  const header = 't,action,head.x,head.y,head.z,hip.x,hip.y,hip.z\r\n';
  const rows = '0,"wave, left",1,2,3,4,5,6\r\n0.05,"wave, left",1,2,3,,,\r\n0.1,walk,1,2,3,4,5,6\r\n';
  const clips = readCsv(`\ufeff${header}${rows}`, 'a.csv', SKELETON);
  assert.deepEqual(clips.map((clip) => [clip.action, clip.frames.length]), [['wave, left', 2], ['walk', 1]]);
  assert.ok(Math.abs(clips[0].rateHz - 20) < 1e-9);
  assert.ok(Number.isNaN(clips[0].frames[1][3]));
  assert.throws(() => readCsv('head.x\n1\n', 'a.csv', SKELETON), /head\.y/);
  assert.throws(() => readCsv(header, 'a.csv', SKELETON), /no frames/);
  assert.throws(() => readCsv(`${header}0,a,x,2,3,4,5,6\n`, 'a.csv', SKELETON), /"x" is no number/);
  for (const row of ['0,"wave,1,2,3,4,5,6\n0,b,1,2,3,4,5,6', '0,wa"ve,1,2,3,4,5,6']) {
    assert.throws(() => readCsv(`${header}0,a,1,2,3,4,5,6\n${row}\n`, 'a.csv', SKELETON), /a quote in row 3/);
  }
});

test('what was asked before signing out reaches nobody', async (t) => {
  const open = [];
  const answer = (body) => ({ ok: true, status: 200, json: async () => body });
  t.mock.method(globalThis, 'fetch', (url, { signal }) => new Promise((resolve, reject) => {
    open.push(resolve);
    signal.addEventListener('abort', () => reject(signal.reason));
  }));
  const api = new Api(new URL('http://x/'), () => 'key');
  const asked = api.skeletons();
  api.leave();
  await assert.rejects(asked, { code: LEFT });
  const next = api.skeletons();
  open[1](answer({ items: [1] }));
  assert.deepEqual(await next, [1]);
  const unreadable = api.skeletons();
  open[2]({ ok: true, status: 200, json: async () => JSON.parse('<html>') });
  await assert.rejects(unreadable, { code: 'unreadable' });
});

test('everybody is listed, page by page', async (t) => {
  const pages = { '': ['a', 'n/x'], 'n/x': ['b', null] };
  t.mock.method(globalThis, 'fetch', async (url) => {
    const [id, cursor] = pages[url.searchParams.get('cursor') ?? ''];
    return { ok: true, status: 200, json: async () => ({ items: [{ id }], next_cursor: cursor }) };
  });
  const api = new Api(new URL('http://x/'), () => 'key');
  assert.deepEqual((await api.users()).map((user) => user.id), ['a', 'b']);
});

test('recordings of any rate are played at 30 Hz, with nobody between clips', () => {
  const frames = [0, 1, 2, 3].map((x) => new Float32Array([x, 0, 0]));
  const player = new Player('a', [{ joints: 1, action: 'x', rateHz: 15, frames }], 'one');
  const played = Array.from({ length: player.total + 2 }, (_, n) => player.frame(n).joints?.[0] ?? null);
  assert.deepEqual(played.slice(0, 8), [0, 0.5, 1, 1.5, 2, 2.5, 3, null]);
  assert.deepEqual(played.slice(-3), [null, 0, 0.5]);
});

test('synthetic people are believable, and the same for the same seed', () => {
  const [one, again, other] = [new SyntheticPerson(1), new SyntheticPerson(1), new SyntheticPerson(2)];
  const length = (pose, a, b) => Math.hypot(...[0, 1, 2].map((i) => pose[3 * a + i] - pose[3 * b + i]));
  const actions = new Set();
  let before = null;
  for (let n = 0; n < 1200; n++) {
    const { joints, action } = one.frame(n);
    actions.add(action);
    assert.deepEqual(again.frame(n).joints, joints);
    assert.ok(joints.every(Number.isFinite));
    for (const [a, b, least, most] of [[4, 5, 0.2, 0.33], [12, 13, 0.35, 0.52], [1, 3, 0.33, 0.5]]) {
      assert.ok(length(joints, a, b) > least && length(joints, a, b) < most, `${action} bone ${a}-${b}`);
    }
    const lowest = Math.min(...[14, 15, 18, 19].map((j) => joints[3 * j + 1]));
    assert.ok(Math.abs(lowest - one.floor) < 0.12, `${action}: feet at ${lowest}`);
    if (before) joints.forEach((x, i) => assert.ok(Math.abs(x - before[i]) < 0.2, `${action} jumps`));
    before = joints;
  }
  assert.ok(actions.size >= 6);
  assert.notDeepEqual(other.frame(0).joints, one.frame(0).joints);
  const start = new SyntheticPerson(1).frame(0).joints;
  assert.ok(start[8 * 3] > start[4 * 3]); // facing the sensor, the right side is at larger x
});

/** A performer without a connection, whose clock is ours. */
function perform(t, source, up = 'y') {
  let now = 1000;
  t.mock.method(performance, 'now', () => now);
  const skeleton = { name: 'one', joints: [{ name: 'hip' }] };
  const performer = new Performer({
    url: new URL('http://x/'), key: () => '', user: { id: 'a', up, version: null }, skeleton, source,
  });
  performer.play(source);
  return { performer, wait: (ms) => { now += ms; performer.tick(); } };
}

test('an error is that of the frame that a forecast was for, or none where the page was held up', (t) => {
  const { performer, wait } = perform(t, { frame: (n) => ({ joints: new Float32Array([n / 100, 0, 0]), action: null }) });
  for (let i = 0; i < 20; i++) wait(1000 / 30 + 1e-6);
  assert.ok(Math.abs(performer.history.last.errors[0].zero - 100) < 0.1);
  for (let i = 0; i < 20; i++) wait(1000); // as in a tab that is not looked at
  assert.equal(performer.history.next, 39 + 1);
  assert.ok(Number.isNaN(performer.history.last.errors[0].zero));
});

test('a synthetic person is turned into the axes of the user, a recording is in them', (t) => {
  const joints = new Float32Array([1, 2, 3]);
  const frame = () => ({ joints, action: null });
  for (const [isYUp, expected] of [[true, [3, 1, 2]], [undefined, [1, 2, 3]]]) {
    const { performer, wait } = perform(t, { frame, isYUp }, 'z');
    wait(40);
    assert.deepEqual([...performer.history.last.joints], expected);
    t.mock.restoreAll();
  }
  assert.equal(new SyntheticPerson(1).isYUp, true);
});

test('a service that greets and hangs up is asked less and less often', (t) => {
  const waits = [];
  class Socket {
    constructor() { sockets.push(this); }
    send() {}
  }
  const sockets = [];
  const known = globalThis.WebSocket;
  globalThis.WebSocket = Socket;
  t.after(() => { globalThis.WebSocket = known; });
  t.mock.method(globalThis, 'setTimeout', (again, ms) => { waits.push(ms); again(); });
  const stream = new Stream({ url: new URL('http://x/'), key: () => '', user: 'a' });
  stream.open();
  for (let i = 0; i < 8; i++) {
    const socket = sockets.at(-1);
    socket.onmessage({ data: encode({ type: 'hello' }).buffer });
    socket.onclose({ code: 1011 });
  }
  assert.equal(waits.length, 8);
  assert.ok(waits[0] <= 100 && waits[7] >= 2500, String(waits));
});

test('a recording survives a link that breaks, and ends where it is refused', (t) => {
  const { performer } = perform(t, { frame: () => ({ joints: null, action: null }) });
  const sockets = [];
  class Socket {
    static OPEN = 1;
    readyState = 1;
    said = [];
    constructor() { sockets.push(this); }
    send(bytes) { this.said.push(decode(bytes)); }
    close() {}
  }
  const known = globalThis.WebSocket;
  globalThis.WebSocket = Socket;
  t.after(() => { globalThis.WebSocket = known; });
  t.mock.method(globalThis, 'setTimeout', (again) => again());
  const hear = (message) => sockets.at(-1).onmessage({ data: encode(message).buffer });
  const said = () => sockets.at(-1).said.map((message) => message.type).filter((type) => type.startsWith('trial'));

  performer.start();
  hear({ type: 'hello', version: null });
  performer.startTrial('one');
  assert.equal(performer.recording.state, 'starting');
  hear({ type: 'error', code: 'invalid_request', message: 'no' });
  assert.equal(performer.recording, null);

  performer.startTrial('two');
  hear({ type: 'trial', trial: performer.recording.trial, state: 'recording' });
  performer.stopTrial(true);
  assert.equal(performer.recording.state, 'storing');
  sockets.at(-1).onclose({ code: 1006 });
  hear({ type: 'hello', version: null });
  assert.deepEqual(said(), ['trial.resume', 'trial.stop']);
  hear({ type: 'trial', trial: performer.recording.trial, state: 'recording' });
  assert.equal(performer.recording.state, 'storing');
  hear({ type: 'error', code: 'trial_unavailable', message: 'wait' });
  assert.notEqual(performer.recording, null);
  hear({ type: 'trial', trial: performer.recording.trial, state: 'stored' });
  assert.equal(performer.recording, null);

  performer.startTrial('three');
  assert.equal(performer.startTrial('twice'), false);
  sockets.at(-1).onclose({ code: 1006 });
  hear({ type: 'hello', version: null });
  hear({ type: 'error', code: 'unknown_trial', message: 'never began' });
  assert.equal(performer.recording, null);

  performer.startTrial('four');
  sockets.at(-1).onclose({ code: 4401 });
  assert.equal(performer.recording, null);
  assert.equal(performer.startTrial('on a stream that has ended'), false);
});

test('what is done names its clip, also after a link that broke', (t) => {
  const pose = new Float32Array(3);
  let action = 'one';
  const { performer, wait } = perform(t, { frame: () => ({ joints: pose, action }) });
  const sockets = [];
  class Socket {
    static OPEN = 1;
    readyState = 1;
    said = [];
    constructor() { sockets.push(this); }
    send(bytes) { this.said.push(decode(bytes)); }
    close() {}
  }
  const known = globalThis.WebSocket;
  globalThis.WebSocket = Socket;
  t.after(() => { globalThis.WebSocket = known; });
  const retries = [];
  t.mock.method(globalThis, 'setTimeout', (again) => retries.push(again));
  const hear = (message) => sockets.at(-1).onmessage({ data: encode(message).buffer });
  const clips = () => sockets.at(-1).said.filter((one) => one.type === 'clip.start').map((one) => one.action);

  performer.start();
  hear({ type: 'hello', version: null });
  performer.startTrial('cut');
  const trial = { type: 'trial', trial: performer.recording.trial, state: 'recording' };
  hear(trial);
  wait(40);
  assert.deepEqual(clips(), ['one']);
  sockets.at(-1).onclose({ code: 1006 });
  action = 'two';
  wait(40); // while nobody hears it
  retries.at(-1)();
  hear({ type: 'hello', version: null });
  hear(trial);
  wait(40);
  assert.deepEqual(clips(), ['two']);
});

test('a link on which nothing comes back is given up', (t) => {
  const sockets = [];
  class Socket {
    static OPEN = 1;
    readyState = 1;
    sent = 0;
    closed = false;
    constructor() { sockets.push(this); }
    send() { this.sent += 1; }
    close() { this.closed = true; }
  }
  const known = globalThis.WebSocket;
  globalThis.WebSocket = Socket;
  t.after(() => { globalThis.WebSocket = known; });
  t.mock.method(globalThis, 'setTimeout', () => 0);
  const stream = new Stream({ url: new URL('http://x/'), key: () => '', user: 'a' });
  stream.open();
  const hear = (message) => sockets[0].onmessage({ data: encode(message).buffer });
  hear({ type: 'hello' });
  for (let seq = 0; seq < 80; seq++) stream.frame(seq, seq / 30, null);
  hear({ type: 'waiting', reason: 'warm_up' });
  sockets[0].bufferedAmount = 1e6;
  stream.frame(80, 80 / 30, null);
  assert.equal(sockets[0].sent, 80); // what cannot leave is not piled up
  for (let seq = 81; seq < 170; seq++) stream.frame(seq, seq / 30, null);
  assert.equal(stream.state, 'open');
  stream.frame(170, 170 / 30, null);
  assert.equal(stream.state, 'waiting');
  assert.ok(sockets[0].closed);
});

/** A zip of arrays that are stored as they are, as far as the reader looks. */
function pack(arrays) {
  const text = new TextEncoder();
  const parts = [];
  const entries = [];
  let at = 0;
  for (const [name, { descr, shape, data }] of Object.entries(arrays)) {
    const header = text.encode(`{'descr': '${descr}', 'fortran_order': False, 'shape': (${shape}), }`);
    const body = new Uint8Array([0x93, 0x4e, 0x55, 0x4d, 0x50, 0x59, 1, 0].slice(0, 8).concat([header.length & 255, header.length >> 8]));
    const bytes = [...body, ...header, ...data];
    const label = text.encode(`${name}.npy`);
    const entry = new DataView(new ArrayBuffer(46));
    entry.setUint32(0, 0x02014b50, true);
    entry.setUint32(20, bytes.length, true);
    entry.setUint16(28, label.length, true);
    entry.setUint32(42, at, true);
    entries.push(...new Uint8Array(entry.buffer), ...label);
    parts.push(...new Uint8Array(30), ...bytes);
    at += 30 + bytes.length;
  }
  const end = new DataView(new ArrayBuffer(22));
  end.setUint32(0, 0x06054b50, true);
  end.setUint16(10, Object.keys(arrays).length, true);
  end.setUint32(16, at, true);
  return new Uint8Array([...parts, ...entries, ...new Uint8Array(end.buffer)]);
}

test('a small file that claims to be a huge one does not hold the page up', async () => {
  const doubles = (...values) => [...new Uint8Array(Float64Array.from(values).buffer)];
  const good = {
    frames: { descr: '<f8', shape: '2, 1, 3', data: doubles(0, 1, 2, 3, 4, 5) },
    lengths: { descr: '<f8', shape: '2,', data: doubles(2, 0) },
    action: { descr: '<U1', shape: '2,', data: [97, 0, 0, 0, 98, 0, 0, 0] },
    rate_hz: { descr: '<f8', shape: '', data: doubles(30) },
  };
  const one = { name: 'one', joints: [{ name: 'hip' }] };
  const read = (changes) => readRecording(new File([pack({ ...good, ...changes })], 'a.npz'), one);
  assert.deepEqual((await read({})).map((clip) => clip.frames.length), [2]);
  const huge = 2e9;
  for (const changes of [
    { frames: { descr: '<f8', shape: `${huge}, 0, 3`, data: [] }, lengths: { descr: '<f8', shape: '1,', data: doubles(huge) } },
    { action: { descr: '<U0', shape: `${huge},`, data: [] } },
    { lengths: { descr: '<f8', shape: '2,', data: doubles(-1, 3) } },
    { frames: { descr: '<f8', shape: 'x, 1, 3', data: doubles(0) } },
    { rate_hz: { descr: '<f8', shape: '', data: doubles(0) } },
  ]) await assert.rejects(read(changes), /a\.npz/);
});
