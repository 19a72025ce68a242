// The bird's-eye view: what there is to draw of a frame, drawing it, and the same as a table.
// Colours are those of M. Okabe and K. Ito, which the colour-blind can tell apart; every layer has a line style, too.

export const LAYERS = {
  own: { label: 'ego alone', colour: '#009e73', dash: [2, 3], width: 1.6 },
  confirmed: { label: 'answered: confirmed', colour: '#0072b2', dash: [], width: 2.4 },
  single_witness: { label: 'answered: single witness', colour: '#e69f00', dash: [9, 3], width: 2.4 },
  disputed: { label: 'answered: disputed', colour: '#cc79a7', dash: [9, 3, 2, 3], width: 2.4 },
  repaired: { label: 'answered: repaired', colour: '#56b4e9', dash: [4, 2], width: 3.2 },
  answered: { label: 'answered: standing not known', colour: '#0072b2', dash: [6, 2, 2, 2], width: 2.4 },
  contradicted: { label: 'left out: contradicted', colour: '#d55e00', dash: [5, 4], width: 2, crossed: true },
  averted: { label: 'only in a rejected fusion', colour: null, dash: [1, 3], width: 1.6, crossed: true },
  vehicles: { label: 'vehicles that send', colour: null, dash: [], width: 2 },
};
export const TEAM_COLOURS = ['#0072b2', '#d55e00', '#009e73', '#cc79a7', '#e69f00', '#56b4e9'];
export const TEAM_DASHES = [[], [7, 3], [2, 3], [9, 3, 2, 3], [4, 2, 1, 2]];

/** All that a frame has to show, by layer: boxes are [x, y, length, width, yaw, score]. */
export function thingsOf(frame) {
  const things = [];
  for (const box of frame.own || []) things.push({ layer: 'own', box });
  for (const { hypothesis, boxes } of frame.averted) {
    for (const box of boxes) things.push({ layer: 'averted', box, note: `test ${hypothesis + 1}` });
  }
  for (const { box, status, witnesses, deniers } of frame.contradicted || []) {
    things.push({ layer: status in LAYERS ? status : 'contradicted', box, witnesses, deniers });
  }
  frame.boxes.forEach((box, i) => {
    const support = frame.support ? frame.support[i] : { status: 'answered', witnesses: [], deniers: [] };
    things.push({ layer: support.status in LAYERS ? support.status : 'answered', box, ...support });
  });
  for (const mate of frame.teammates) things.push({ layer: 'vehicles', mate });
  return things;
}

const toDegrees = (yaw) => (yaw * 180) / Math.PI;

/** Rows of the table: the same things, of the layers that are shown. */
export function rowsOf(things, shown) {
  return things.filter((thing) => shown.has(thing.layer)).map(({ layer, box, mate, note, witnesses, deniers }) => {
    const what = LAYERS[layer].label + (note ? ` (${note})` : '');
    if (mate) {
      const place = [mate.x.toFixed(2), mate.y.toFixed(2), '', '', toDegrees(mate.yaw).toFixed(1), ''];
      return [`vehicle ${mate.vehicle_id}, ${mate.range_m.toFixed(1)} m`, ...place, '', ''];
    }
    const [x, y, length, width, yaw, score] = box;
    const numbers = [x, y, length, width].map((value) => value.toFixed(2));
    return [what, ...numbers, toDegrees(yaw).toFixed(1), score.toFixed(2),
      (witnesses || []).join(', '), (deniers || []).join(', ')];
  });
}

/** A canvas in the size that it has on the screen, cleared; its context counts in CSS pixels. */
export function cleared(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  const style = getComputedStyle(document.documentElement);
  const ink = (name) => style.getPropertyValue(name).trim();
  return { context, width, height, text: ink('--text'), faint: ink('--faint'), line: ink('--line'), ground: ink('--ground') };
}

/** Draw a frame's things, `radius` metres around the ego: x to the right, y up. */
export function drawScene(canvas, frame, things, shown, radius, leastScore) {
  const { context: pen, width, height, text, faint, line, ground } = cleared(canvas);
  const scale = Math.min(width, height) / (2 * radius);
  const at = (x, y) => [width / 2 + x * scale, height / 2 - y * scale];
  Object.assign(canvas.dataset, { scale, frame: frame.frame });
  pen.font = '12px system-ui, sans-serif';
  drawRings(pen, at, scale, radius, line, faint);
  for (const { layer, box, mate } of things) {
    if (!shown.has(layer)) continue;
    if (mate) drawMate(pen, at, mate, frame, radius, text, ground);
    else drawBox(pen, at, box, LAYERS[layer], text, leastScore);
  }
  drawArrow(pen, at(0, 0), 0, 9, text, true);
}

function drawRings(pen, at, scale, radius, line, faint) {
  pen.strokeStyle = line;
  pen.fillStyle = faint;
  pen.lineWidth = 1;
  pen.setLineDash([]);
  const step = radius > 60 ? 20 : 10;
  for (let metres = step; metres < radius * 1.42; metres += step) {
    pen.beginPath();
    pen.arc(...at(0, 0), metres * scale, 0, 2 * Math.PI);
    pen.stroke();
    if (metres < radius) pen.fillText(`${metres} m`, at(0, 0)[0] + 3, at(0, metres)[1] - 3);
  }
}

function cornersOf([x, y, length, width, yaw]) {
  const [c, s] = [Math.cos(yaw), Math.sin(yaw)];
  return [[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]].map(([a, b]) => [
    x + a * length * c - b * width * s, y + a * length * s + b * width * c]);
}

function drawBox(pen, at, box, style, text, leastScore) {
  const corners = cornersOf(box).map(([x, y]) => at(x, y));
  pen.strokeStyle = style.colour || text;
  pen.lineWidth = box[5] >= leastScore ? style.width : style.width / 2;
  pen.setLineDash(style.dash);
  pen.beginPath();
  corners.forEach((corner) => pen.lineTo(...corner));
  pen.closePath();
  if (style.crossed) {
    pen.moveTo(...corners[0]);
    pen.lineTo(...corners[2]);
  }
  pen.stroke();
  const [x, y, length, , yaw] = box;  // a line out of its front
  pen.setLineDash([]);
  pen.beginPath();
  pen.moveTo(...at(x + (length / 2) * Math.cos(yaw), y + (length / 2) * Math.sin(yaw)));
  pen.lineTo(...at(x + (length / 2 + 0.8) * Math.cos(yaw), y + (length / 2 + 0.8) * Math.sin(yaw)));
  pen.stroke();
}

function drawMate(pen, at, mate, frame, radius, text, ground) {
  const beyond = Math.max(Math.abs(mate.x), Math.abs(mate.y)) / (radius * 0.96);
  const place = beyond > 1 ? at(mate.x / beyond, mate.y / beyond) : at(mate.x, mate.y);
  const accepted = frame.accepted.includes(mate.vehicle_id);
  const named = frame.named.includes(mate.vehicle_id);
  drawArrow(pen, place, mate.yaw, named ? 9 : 7, named ? '#d55e00' : text, accepted);
  const label = `${mate.vehicle_id}${named ? ', named' : accepted ? '' : ', left out'}${beyond > 1 ? `, ${mate.range_m.toFixed(0)} m` : ''}`;
  pen.fillStyle = text;
  pen.textAlign = place[0] > at(0, 0)[0] ? 'right' : 'left';
  const [x, y] = [place[0] + (pen.textAlign === 'left' ? 9 : -9), place[1] - 8];
  pen.setLineDash([]);
  pen.lineWidth = 4; // a seam in the ground's colour, so that lines below do not hide the words
  pen.strokeStyle = ground;
  pen.strokeText(label, x, y);
  pen.fillText(label, x, y);
  pen.textAlign = 'left';
}

function drawArrow(pen, [x, y], yaw, size, colour, filled) {
  pen.save();
  pen.translate(x, y);
  pen.rotate(-yaw);
  pen.setLineDash([]);
  pen.lineWidth = 2;
  pen.strokeStyle = pen.fillStyle = colour;
  pen.beginPath();
  pen.moveTo(size, 0);
  pen.lineTo(-size, size * 0.7);
  pen.lineTo(-size * 0.5, 0);
  pen.lineTo(-size, -size * 0.7);
  pen.closePath();
  if (filled) pen.fill();
  pen.stroke();
  pen.restore();
}
