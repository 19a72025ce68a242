// The live page: which session is watched, the connection, and which of the frames received is shown.
import { Refused, ask, follow } from './stream.js';
import { drawScene, rowsOf, thingsOf } from './scene.js';
import { byId, drawSuspicion, made, makeLegend, showLog, showNamed, showTeam, showTests, showTime } from './panels.js';

const KEPT = 1500; // frames: five minutes at 5 a second
const POLL_MS = 2000;
const SILENCE_MS = 40000; // the gateway says something every 15 s
const TOKEN = 'robosac-viewer-token';

/** The session that the address names; the newest where it names none that can be. */
function linked() {
  try {
    return decodeURIComponent(location.hash.slice(1));
  } catch {
    return '';
  }
}

const state = {
  frames: [], audit: new Map(), about: null, cursor: -1, live: true, radius: 36, dropped: 0,
  chosen: linked(), watched: '', stream: null, heard: 0, drawn: 0,
};
const token = () => sessionStorage.getItem(TOKEN) || '';
const shown = makeLegend(byId('legend'), () => draw());

function say(text, lost = false) {
  const line = byId('state');
  if (line.textContent !== text) line.textContent = text;
  line.className = lost ? 'lost' : '';
}

// --- connection

async function poll() {
  await attempt();
  if (state.stream && Date.now() - state.heard > SILENCE_MS) state.stream.abort();
  setTimeout(poll, POLL_MS);
}

async function attempt() {
  try {
    const { sessions } = await (await ask('v1/live', token(), AbortSignal.timeout(8000))).json();
    byId('token-form').hidden = true;
    choose(sessions);
  } catch (error) {
    if (error instanceof Refused && error.status === 401) askForToken();
    else say('Connection lost; trying again', true);
  }
}

function askForToken() {
  const form = byId('token-form');
  if (form.hidden) {
    form.hidden = false;
    byId('token').focus();
  }
  say(token() ? 'The gateway does not know this token' : 'A viewer\'s token is needed', true);
}

byId('token-form').addEventListener('submit', (event) => {
  event.preventDefault();
  sessionStorage.setItem(TOKEN, byId('token').value.trim());
  byId('token').value = '';
  say('Trying the token');
  attempt();
});

function choose(sessions) {
  showSessions(sessions);
  const newest = sessions.reduce((one, other) => (!one || other.created_at > one.created_at ? other : one), null);
  const stays = !state.live && sessions.some((session) => session.session_id === state.watched); // what is looked at
  const wanted = state.chosen || (stays ? state.watched : newest ? newest.session_id : '');
  const there = sessions.some((session) => session.session_id === wanted);
  if (!there) {
    if (!state.stream) say(state.chosen ? 'No frame of this session was answered lately' : 'Connected; no session has frames yet');
    return;
  }
  if (wanted !== state.watched) {
    if (state.stream) state.stream.abort();
    Object.assign(state, { frames: [], audit: new Map(), about: null, cursor: -1, live: true, watched: wanted, stream: null, dropped: 0 });
  }
  if (!state.stream) watch(wanted);
}

async function watch(session) {
  const stream = new AbortController();
  state.stream = stream;
  state.heard = Date.now();
  const last = state.frames.length ? state.frames.at(-1).frame : -1;
  const heard = () => { state.heard = Date.now(); };
  try {
    say('Connecting');
    await follow(`v1/live/${encodeURIComponent(session)}?after=${last}`, token(), stream.signal, heard, (name, data) => {
      if (state.stream === stream) take(name, data);
    });
    if (state.stream === stream) say('Connection lost; trying again', true);
  } catch (error) {
    if (state.stream !== stream) return;
    if (error instanceof Refused && error.status === 401) askForToken();
    else say(error instanceof Refused ? error.message : 'Connection lost; trying again', true);
  }
  if (state.stream === stream) state.stream = null;
}

function take(name, data) {
  if (name === 'session') state.about = data;
  if (name === 'dropped') state.dropped += data.frames;
  if (name === 'frames') {
    state.dropped += data.skipped;
    for (const entry of data.audit) state.audit.set(entry.seq, entry);
    while (state.audit.size > 200) state.audit.delete(state.audit.keys().next().value);
    add(data.frames);
  }
  say('Connected');
}

function add(fresh) {
  const last = state.frames.length ? state.frames.at(-1).frame : -1;
  state.frames.push(...fresh.filter((frame) => frame.frame > last));
  const over = Math.max(0, state.frames.length - KEPT);
  state.frames.splice(0, over);
  state.cursor = state.live ? state.frames.length - 1 : Math.max(0, state.cursor - over);
  draw();
}

// --- sessions

function showSessions(sessions) {
  const button = (id, title, lines, current) => {
    const element = made('button', [made('span', title), ...lines.map((line) => made('small', line))]);
    element.type = 'button';
    element.dataset.session = id;
    element.setAttribute('aria-current', String(current));
    element.addEventListener('click', () => {
      state.chosen = id;
      history.replaceState(null, '', id ? `#${encodeURIComponent(id)}` : location.pathname);
      choose(sessions);
    });
    return made('li', [element]);
  };
  const focused = document.activeElement && document.activeElement.dataset.session;
  byId('sessions').replaceChildren(
    button('', 'The newest', [`of ${sessions.length}`], !state.chosen),
    ...sessions.slice(0, 50).map((session) => button(session.session_id, session.ego_id, [
      session.session_id.slice(0, 8), `${session.detector}, ${session.defense}`,
      `${session.frames} ${session.frames === 1 ? 'frame' : 'frames'}, since ${session.created_at.slice(11, 19)}`,
      session.named.length ? `named: ${session.named.join(', ')}` : 'nobody named',
    ], state.chosen === session.session_id)),
  );
  if (focused !== undefined && focused !== null) {
    const again = [...byId('sessions').querySelectorAll('button')].find((element) => element.dataset.session === focused);
    if (again) again.focus();
  }
}

// --- the frame that is shown

function draw() {
  const frame = state.frames[state.cursor];
  byId('none').hidden = Boolean(frame);
  byId('shown').hidden = !frame;
  if (!frame || !state.about) return;
  const things = thingsOf(frame);
  const counted = (layer) => things.filter((thing) => thing.layer === layer).length;
  drawScene(byId('scene'), frame, things, shown, state.radius, state.about.least_score);
  byId('scene').setAttribute('aria-label', `Bird's-eye view of frame ${frame.frame}: ${frame.boxes.length} answered boxes, `
    + `${counted('own')} that the ego sees alone, ${counted('contradicted')} contradicted, ${counted('averted')} only in a rejected fusion; the table below says where`);
  byId('frame-line').textContent = `${state.about.ego_id}, frame ${frame.frame}: ${frame.boxes.length} boxes, ${frame.source.replace('_', ' ')}, `
    + `${state.live ? 'live' : 'paused'}${state.dropped ? `; ${state.dropped} frames were not sent, as they came too fast` : ''}`;
  if (byId('table-details').open) {
    byId('table').replaceChildren(...rowsOf(things, shown).map(([what, ...cells]) => {
      const head = made('th', what);
      head.scope = 'row';
      return made('tr', [head, ...cells.map((cell) => made('td', cell))]);
    }));
  }
  showTeam(byId('team'), frame);
  drawSuspicion(byId('suspicion'), state.frames, state.cursor);
  showNamed(byId('named'), frame);
  showTests(byId('tests'), frame);
  showTime(byId('time-line'), byId('stages'), frame, state.about.latency_budget_ms);
  showLog(byId('log'), state.frames, state.cursor, state.audit);
  const scrub = byId('scrub');
  scrub.max = String(state.frames.length - 1);
  scrub.value = String(state.cursor);
  scrub.setAttribute('aria-valuetext', `frame ${frame.frame}`);
  byId('pause').textContent = state.live ? 'Pause' : 'Go on';
}

function go(cursor) {
  state.live = false;
  state.cursor = Math.min(Math.max(0, cursor), state.frames.length - 1);
  draw();
}

function toggle(live = !state.live) {
  state.live = live;
  if (live) state.cursor = state.frames.length - 1;
  draw();
}

function zoom(factor) {
  state.radius = Math.min(150, Math.max(10, state.radius * factor));
  draw();
}

byId('pause').addEventListener('click', () => toggle());
byId('back').addEventListener('click', () => go(state.cursor - 1));
byId('forth').addEventListener('click', () => go(state.cursor + 1));
byId('closer').addEventListener('click', () => zoom(1 / 1.25));
byId('wider').addEventListener('click', () => zoom(1.25));
byId('scrub').addEventListener('input', (event) => go(Number(event.target.value)));
byId('table-details').addEventListener('toggle', () => draw());
addEventListener('resize', () => draw());
matchMedia('(prefers-color-scheme: dark)').addEventListener('change', () => draw());
addEventListener('hashchange', () => { state.chosen = linked(); });

const KEYS = {
  ' ': () => toggle(), ArrowLeft: () => go(state.cursor - 1), ArrowRight: () => go(state.cursor + 1),
  Home: () => go(0), End: () => toggle(true), '+': () => zoom(1 / 1.25), '-': () => zoom(1.25),
};
addEventListener('keydown', (event) => {
  const act = KEYS[event.key];
  const own = event.target.closest('input, button, summary, a, [tabindex="0"]');
  if (!act || !state.frames.length || event.ctrlKey || event.altKey || event.metaKey) return;
  if (own && (event.target.tagName === 'INPUT' || event.key === ' ')) return; // keys that it has itself
  event.preventDefault();
  act();
});

poll();
