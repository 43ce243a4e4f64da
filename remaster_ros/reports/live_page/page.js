'use strict';
// Shows the view that the server gives, several times a second, and sends what a person asks for.
// Texts from the network become text nodes, never HTML.

const EVERY_MS = 300;
const TIMEOUT_MS = 4000;
const OLD_MS = 3000;

const get = (id) => document.getElementById(id);
const token = takeToken();
let shown = null;
let shownAt = -Infinity;
let asked = null;
let lookedAt = '';

// The token comes behind the # of the address and is kept for this tab alone.
function takeToken() {
  const found = /^#token=([\w-]+)$/.exec(location.hash);
  if (found) {
    sessionStorage.setItem('token', found[1]);
    history.replaceState(null, '', location.pathname);
  }
  return sessionStorage.getItem('token') || '';
}

async function request(path, options = {}) {
  const response = await fetch(path, {
    ...options,
    headers: { Authorization: `Bearer ${token}` },
    cache: 'no-store',
    credentials: 'omit',
    signal: AbortSignal.timeout(options.method ? 2 * TIMEOUT_MS : TIMEOUT_MS),
  });
  const content = await response.json();
  if (!response.ok) throw new Error(content.message || response.statusText);
  return content;
}

function setText(id, text) {
  const element = get(id);
  if (element.textContent !== text) element.textContent = text;
}

function banner(id, text, mood) {
  setText(id, text);
  if (mood) get(id).className = `banner ${mood}`;
  get(id).hidden = !text;
}

// Rows of cells; a cell is text, or [text, class].
function fill(id, rows) {
  const key = JSON.stringify(rows);
  const body = get(id).querySelector('tbody') || get(id);
  if (body.dataset.key === key) return;
  body.dataset.key = key;
  body.replaceChildren(...rows.map((row) => {
    const line = document.createElement(body.tagName === 'OL' ? 'li' : 'tr');
    if (body.tagName === 'OL') {
      line.textContent = row;
      return line;
    }
    line.append(...row.map((cell) => {
      const [text, kind] = Array.isArray(cell) ? cell : [cell, ''];
      const data = document.createElement('td');
      data.className = kind;
      data.textContent = text;
      return data;
    }));
    return line;
  }));
}

const number = (value, digits, unit) => (value === null || value === undefined ? '–' : `${value.toFixed(digits)} ${unit}`.trim());

function ago(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s ago`;
  return `${Math.round(seconds / 60)} min ago`;
}

const STATES = {
  '': 'waiting for the nodes', silent: 'pose_planner is silent', idle: 'ready', running: 'collecting', held: 'held',
  paused: 'paused', stopped: 'stopped', complete: 'collection complete', failed: 'failed',
};

function show(view) {
  const run = view.run;
  const state = STATES[run.state] || run.state;
  setText('state', run.state === 'running' && run.phase === 'registration' ? 'registering the sensors' : state);
  document.title = run.of ? `${run.done}/${run.of} ${state}` : `${state} – remaster`;
  setText('message', [run.message === run.state ? '' : run.message,
    run.waiting_for ? `waiting for ${run.waiting_for}` : ''].filter(Boolean).join('; '));
  banner('halt', view.halted && `The arm is halted: ${view.halted}. Look at the arm and remove the cause. This page `
    + 'cannot end a halt: ros2 service call /remaster/clear_halt std_srvs/srv/Trigger does.');
  banner('changed', view.changed && `Changed since the reference: ${view.changed}`);
  get('bar').max = run.of || 1;
  get('bar').value = run.done;
  setText('count', run.of ? `${run.done} of ${run.of} configurations, ${run.poses_done} of ${run.poses} poses` : '');
  setText('left', run.left && `– ${run.left}`);
  setText('plan', run.plan);
  setText('plan-details', run.plan_details);
  get('plan-fold').hidden = !run.plan_details;
  for (const [name, command] of Object.entries(view.commands)) {
    const button = get(name);
    button.disabled = !command.on;
    button.title = command.note;
    if (button.textContent !== command.label) button.textContent = command.label;
  }
  showConfirmation(view.confirmation, view.commands.confirm);
  setText('stop-note', view.commands.stop.note);
  fill('sensors', view.sensors.map((s) => [
    s.name,
    [sensorState(s), s.hidden ? 'warn' : s.ready ? 'ok' : 'error'],
    [s.read_age_s === null || s.read_age_s === undefined ? '–' : `${s.read_age_s < 1 ? 'now' : ago(s.read_age_s)}`, 'n'],
    [number(s.median_mm, 3, 'mm'), 'n'],
  ]));
  fill('nodes', view.nodes.map((n) => [[n.name, n.level], n.message]));
  fill('messages', view.messages.map((m) => `${ago(m.age_s)}: ${m.text}`));
  showResult(view.result);
  drawResiduals(view.sensors);
  drawPrecision(view.precision);
  drawScene(view.scene);
  if (asked && view.seen !== asked.seen && get('sure').open) {
    get('sure').close();
    banner('answer', 'The collection has changed meanwhile; look again.', 'caution');
  }
}

// A plan can be confirmed in this tab once it was opened from here; another one asks for it anew.
function showConfirmation(confirmation, command) {
  get('confirmation').hidden = !confirmation;
  if (!confirmation) return;
  const { plan, confirmed, page, address, trouble } = confirmation;
  const looked = lookedAt === plan;
  get('confirmation').className = `banner ${confirmed ? 'good' : 'caution'}`;
  setText('plan-state', confirmed ? `Plan ${plan} is confirmed.` : `The arm waits for your confirmation of plan ${plan}.`);
  const link = get('plan-link');
  link.hidden = !address;
  if (address && link.getAttribute('href') !== address) link.href = address;
  link.dataset.plan = plan;
  get('confirm').hidden = confirmed;
  get('confirm').disabled = !command.on || !looked;
  if (confirmed) setText('plan-note', '');
  else if (trouble) setText('plan-note', `It cannot be shown here: ${trouble}. Open ${page} on the computer of pose_planner; it has the command that confirms it.`);
  else if (!address) setText('plan-note', 'It is being fetched.');
  else if (!confirmation.offered) setText('plan-note', `The service of pose_planner that confirms plan ${plan} is not there yet.`);
  else setText('plan-note', looked ? command.note : 'Look at the plan first: every way and every configuration.');
}

function sensorState(sensor) {
  const words = sensor.hidden ? 'does not see its marker' : sensor.ready ? 'measures' : 'not ready';
  const registered = sensor.registered ? '' : ', not registered yet';
  const more = ['ok', 'ready', ''].includes(sensor.message) ? '' : `: ${sensor.message}`;
  return words + registered + more;
}

function showResult(result) {
  get('result').hidden = result.joints.length === 0;
  fill('offsets', result.joints.map((j) => {
    // Degrees, or millimetres of a joint that slides.
    const [mean, std, unit] = j.unit === 'mm' ? [j.mean_mm, j.std_mm, 'mm'] : [j.mean_deg, j.std_deg, ''];
    return [j.joint, [std === null ? 'not identifiable' : number(mean, 4, unit), 'n'], [number(std, 4, unit), 'n']];
  }));
  const key = JSON.stringify(result.fit);
  const list = get('fit-facts');
  if (list.dataset.key === key) return;
  list.dataset.key = key;
  list.replaceChildren(...Object.entries(result.fit).flatMap(([label, text]) => {
    const term = document.createElement('dt');
    const what = document.createElement('dd');
    term.textContent = label;
    what.textContent = text;
    return [term, what];
  }));
}

// What the view no longer tells must not look as if it still held.
function showLink() {
  const age = performance.now() - shownAt;
  const old = age > OLD_MS;
  document.body.classList.toggle('old', old);
  if (!old) return;
  for (const name of ['collect', 'pause', 'fit', 'confirm']) get(name).disabled = true;
  if (get('sure').open) get('sure').close();
  const since = Number.isFinite(age) ? ` What is shown is ${Math.round(age / 1000)} s old.` : '';
  banner('link', `${lastError || 'No answer from remaster watch.'}${since} Stop may not get through: use the red button.`);
}

let lastError = '';

async function look() {
  try {
    const answer = await request('view');
    if (answer.view === null || answer.age_s > OLD_MS / 1000) {
      lastError = 'remaster watch hears nothing from its node.';
    } else {
      lastError = '';
      shown = answer;
      shownAt = performance.now();
      banner('link', '');
      show(answer.view);
    }
  } catch (error) {
    lastError = error.name === 'Error' ? `${error.message}.` : 'No connection to remaster watch.';
  }
  showLink();
  setTimeout(look, EVERY_MS);
}

async function command(name, body) {
  banner('answer', `${name}: asking`, '');
  try {
    const answer = await request(`command/${name}`, { method: 'POST', body: body && JSON.stringify(body) });
    banner('answer', `${name}: ${answer.message}`, answer.done ? 'good' : 'bad');
  } catch (error) {
    const why = error.name === 'Error' ? error.message : 'no connection to remaster watch';
    const more = name === 'stop' || name === 'pause' ? ' – use the red button if the arm has to stop' : '';
    banner('answer', `${name} was not done: ${why}${more}`, 'bad');
  }
}

for (const name of ['pause', 'stop', 'fit']) get(name).addEventListener('click', () => command(name));
get('collect').addEventListener('click', () => {
  asked = { seen: shown.view.seen };
  setText('sure-what', shown.view.commands.collect.label);
  get('sure').showModal();
});
get('plan-link').addEventListener('click', () => { lookedAt = get('plan-link').dataset.plan; });
get('confirm').addEventListener('click', () => command('confirm', { view: shown.number, seen: shown.view.seen }));
get('sure-yes').addEventListener('click', () => {
  if (asked) command('collect', { view: shown.number, seen: asked.seen });
  asked = null;
});

if (token) {
  // Until here a press would have done nothing.
  get('stop').disabled = false;
  request('scene').then(setScene).catch(() => setText('scene-note', 'No 3-D picture: it did not arrive.'));
  look();
} else {
  setText('state', 'no token');
  banner('link', 'Open this page by the address that remaster watch gives; it ends in #token=…');
}
