/** A row for each frame: `t`, `clip` and `action` (optional), and NAME.x, NAME.y, NAME.z. */

const FPS = 30;

/**
 * @param {string} text
 * @param {string} name
 * @param {{name: string, joints: {name: string}[]}} skeleton
 * @returns {import('./recording.js').Clip[]}
 * @throws {Error} it is no such file
 */
export function readCsv(text, name, skeleton) {
  const [header, ...rows] = parseRows(text.replace(/^\ufeff/, ''), name);
  if (!header || !rows.length) throw new Error(`${name}: it has no frames.`);
  const place = new Map(header.map((column, i) => [column, i]));
  const columns = skeleton.joints.flatMap((joint) => ['x', 'y', 'z'].map((axis) => `${joint.name}.${axis}`));
  const missing = columns.find((column) => !place.has(column));
  if (missing) throw new Error(`${name}: it lacks the column ${missing} of ${skeleton.name}.`);
  const cell = (row, column) => (place.has(column) ? (row[place.get(column)] ?? '') : '');
  const clips = [];
  let last = null;
  for (const row of rows) {
    const mark = JSON.stringify([cell(row, 'clip'), cell(row, 'action')]);
    if (mark !== last) {
      clips.push({ action: cell(row, 'action') || null, times: [], frames: [] });
      last = mark;
    }
    const clip = clips.at(-1);
    clip.times.push(readNumber(cell(row, 't'), name));
    clip.frames.push(Float32Array.from(columns, (column) => readNumber(cell(row, column), name)));
  }
  return clips.map(({ action, times, frames }) => ({
    joints: skeleton.joints.length, action, rateHz: findRate(times), frames,
  }));
}

function findRate(times) {
  const seconds = times.at(-1) - times[0];
  return times.length > 1 && seconds > 0 ? (times.length - 1) / seconds : FPS;
}

function readNumber(cell, name) {
  if (!cell.trim()) return NaN;
  const number = Number(cell);
  if (Number.isNaN(number) && cell.trim().toLowerCase() !== 'nan') {
    throw new Error(`${name}: "${cell.slice(0, 40)}" is no number.`);
  }
  return number;
}

/** Rows of cells; a cell in quotes may hold commas, line breaks and doubled quotes. */
function parseRows(text, name) {
  const rows = [[]];
  const pattern = /(?:"((?:[^"]|"")*)"|([^",\r\n]*))(,|\r\n?|\n|$)/gy;
  for (;;) {
    const found = pattern.exec(text);
    if (!found) throw new Error(`${name}: a quote in row ${rows.length} is never closed, or stands in the middle of a cell.`);
    rows.at(-1).push(found[1] !== undefined ? found[1].replaceAll('""', '"') : found[2]);
    if (pattern.lastIndex >= text.length && found[3] !== ',') break;
    if (found[3] !== ',') rows.push([]);
  }
  return rows.filter((row) => row.some((cell) => cell.trim()));
}
