// Everything beside the view: team, suspicion, tests, time, log. Texts are only ever set as texts.
import { LAYERS, TEAM_COLOURS, TEAM_DASHES, cleared } from './scene.js';

const STAGES = ['receive', 'gather', 'queue', 'screening', 'prepare', 'testimony', 'ego_only', 'hypotheses', 'consensus', 'store'];
const STAGE_WORDS = { ego_only: 'ego alone', hypotheses: 'tests', consensus: 'comparing' };
const VERDICTS = { consensus: 'in consensus', dissensus: 'in dissensus', no_evidence: 'no evidence' };
const HISTORY = 150;
const LOG_LINES = 60;

export const byId = (id) => document.getElementById(id);

/** An element with a text, or with children. */
export function made(tag, content = '', className = '') {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (Array.isArray(content)) element.append(...content);
  else element.textContent = content;
  return element;
}

const tell = (element, children) => element.replaceChildren(...children);

/** A short line in a colour and style. */
export function swatch(colour, dash, width) {
  const svg = document.createElementNS('http://www.w3.org/2000/svg', 'svg');
  const line = document.createElementNS('http://www.w3.org/2000/svg', 'line');
  const set = (element, values) => Object.entries(values).forEach(([name, value]) => element.setAttribute(name, value));
  set(svg, { width: 26, height: 10, 'aria-hidden': 'true' });
  set(line, { x1: 0, x2: 26, y1: 5, y2: 5, stroke: colour || 'currentColor', 'stroke-width': width, 'stroke-dasharray': dash.join(' ') });
  svg.append(line);
  return svg;
}

/** Checkboxes that show and hide the layers; `changed(shown)` is called with the set of those shown. */
export function makeLegend(fieldset, changed) {
  const shown = new Set(Object.keys(LAYERS));
  for (const [name, { label, colour, dash, width }] of Object.entries(LAYERS)) {
    const box = made('input');
    Object.assign(box, { type: 'checkbox', checked: true, name });
    box.addEventListener('change', () => {
      shown[box.checked ? 'add' : 'delete'](name);
      changed();
    });
    fieldset.append(made('label', [box, swatch(colour, dash, width), label]));
  }
  return shown;
}

const lineOf = (names, name) => {
  const i = names.indexOf(name);
  return [TEAM_COLOURS[i % TEAM_COLOURS.length], TEAM_DASHES[i % TEAM_DASHES.length]];
};

export function namesOf(frame) {
  return [...new Set([...frame.accepted, ...frame.rejected.map((entry) => entry.vehicle_id)])].sort();
}

/** A vehicle may be called as what every object has, such as "constructor". */
function suspicionOf(frame, name) {
  return frame.suspicion && Object.hasOwn(frame.suspicion, name) ? frame.suspicion[name] : undefined;
}

export function showTeam(body, frame) {
  const names = namesOf(frame);
  const ranges = new Map(frame.teammates.map((mate) => [mate.vehicle_id, mate.range_m]));
  tell(body, names.map((name) => {
    const entry = frame.rejected.find((one) => one.vehicle_id === name);
    const named = frame.named.includes(name);
    const suspicion = suspicionOf(frame, name);
    const head = made('th', [swatch(...lineOf(names, name), 2.5), ` ${name}`]);
    head.scope = 'row';
    return made('tr', [
      head,
      made('td', ranges.has(name) ? `${ranges.get(name).toFixed(1)} m` : 'not known'),
      made('td', suspicion === undefined ? 'not known' : suspicion.toFixed(3), suspicion > 0.5 ? 'alarm' : ''),
      made('td', entry ? `left out: ${entry.why}` : 'in the answer', named ? 'alarm' : ''),
    ]);
  }));
}

export function drawSuspicion(canvas, frames, cursor) {
  const { context: pen, width, height, faint, line } = cleared(canvas);
  const past = frames.slice(Math.max(0, cursor + 1 - HISTORY), cursor + 1);
  const names = namesOf(frames[cursor]);
  const [left, top, right, bottom] = [30, 8, width - 8, height - 18];
  const at = (i, p) => [left + ((right - left) * i) / Math.max(1, past.length - 1), bottom - (bottom - top) * p];
  pen.font = '11px system-ui, sans-serif';
  pen.fillStyle = faint;
  pen.strokeStyle = line;
  for (const p of [0, 0.5, 1]) {
    pen.beginPath();
    pen.moveTo(...at(0, p));
    pen.lineTo(right, at(0, p)[1]);
    pen.stroke();
    pen.fillText(p.toFixed(1), 6, at(0, p)[1] + 4);
  }
  if (past.length) {
    pen.fillText(`frame ${past[0].frame}`, left, height - 4);
    pen.textAlign = 'right';
    pen.fillText(`frame ${past.at(-1).frame}`, right, height - 4);
    pen.textAlign = 'left';
  }
  const now = [];
  for (const name of names) {
    const [colour, dash] = lineOf(names, name);
    pen.strokeStyle = colour;
    pen.lineWidth = 2;
    pen.setLineDash(dash);
    pen.beginPath();
    past.forEach((frame, i) => {
      const p = suspicionOf(frame, name);
      if (p !== undefined) pen.lineTo(...at(i, p));
    });
    pen.stroke();
    const p = suspicionOf(frames[cursor], name);
    now.push(`${name} ${p === undefined ? 'not known' : p.toFixed(2)}`);
  }
  pen.setLineDash([]);
  canvas.setAttribute('aria-label', `Suspicion over ${past.length} frames; at the end: ${now.join(', ')}`);
}

export function showNamed(place, frame) {
  const named = frame.rejected.filter((entry) => frame.named.includes(entry.vehicle_id));
  if (!named.length) {
    tell(place, [made('p', 'Nobody is named.')]);
    return;
  }
  tell(place, named.flatMap(({ vehicle_id: name, why, evidence }) => [
    made('h3', name, 'alarm'),
    made('p', `Left out: ${why}.`),
    made('ul', evidence.map((sentence) => made('li', sentence))),
  ]));
}

export function showTests(list, frame) {
  tell(list, frame.hypotheses.length ? frame.hypotheses.map(({ teammates, jaccard_index: index, verdict }, i) => made('li', [
    made('span', `${i + 1}. ${teammates.join(', ')}`),
    made('span', `${VERDICTS[verdict] || verdict}, agreement ${index.toFixed(2)}`, verdict === 'dissensus' ? 'alarm' : ''),
  ])) : [made('li', 'None.')]);
}

export function showTime(line, list, frame, budget) {
  const spent = frame.timings_ms;
  const total = spent.total || 0;
  const left = total - STAGES.reduce((sum, stage) => sum + (spent[stage] || 0), 0);
  const late = frame.deadline_met ? 'in time' : 'late';
  line.textContent = `${total.toFixed(1)} ms of ${budget} ms: ${late}${frame.degraded_by ? `, cut short by ${frame.degraded_by}` : ''}`;
  line.className = frame.deadline_met ? '' : 'alarm';
  const rows = [...STAGES.map((stage) => [stage, spent[stage]]), ['other', Math.max(0, left)]];
  tell(list, rows.filter(([, ms]) => ms !== undefined).map(([stage, ms]) => {
    const bar = made('span', '', 'bar');
    bar.style.width = `${Math.min(100, (100 * ms) / budget)}%`;
    return made('li', [made('span', STAGE_WORDS[stage] || stage), made('span', `${ms.toFixed(1)} ms`), bar]);
  }));
}

export function showLog(list, frames, cursor, audit) {
  const past = frames.slice(Math.max(0, cursor + 1 - LOG_LINES), cursor + 1);
  const live = cursor === frames.length - 1;
  const lines = past.map((frame) => ({ seq: frame.seq, time: new Date(frame.time * 1e3).toISOString(), text: frame.sentence }));
  const last = past.length ? past.at(-1).seq : Infinity;
  const others = [...audit.values()].filter((entry) => live || entry.seq <= last);
  const latest = [...lines, ...others].sort((a, b) => b.seq - a.seq).slice(0, LOG_LINES);
  tell(list, latest.map(({ seq, time, text }) => made('li', [made('small', `${seq} ${time.slice(11, 19)} `), text])));
}
