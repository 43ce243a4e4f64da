// Plays a plan (reports/plan_page.py): every way in its own time, every configuration.

async function playPlan(plan) {
  const element = (id) => document.getElementById(id);
  const {visits, words, ramp_s: RAMP, rest_s: REST} = plan;

  // Times of all lines: `begin` and `end` of a visit, `arrive` between its way and its standing.
  let total = 0;
  let here = plan.start;
  for (const visit of visits) {
    visit.begin = total;
    visit.from = here;
    // A curve is played through samples, a line by its ramps.
    visit.lines = visit.times ? [] : visit.way.map((to, i) => {
      if (i) total += REST;
      const line = {from: here, to, rate: visit.rates[i], begin: total};
      total += 1 / line.rate + RAMP;
      here = to;
      return line;
    });
    if (visit.times) {
      total += visit.times[visit.times.length - 1];
      here = visit.way[visit.way.length - 1];
    }
    visit.arrive = total;
    total += plan.measuring_s;
    visit.end = total;
  }

  // The share of a line that is gone after a time: ramp up, cruise, ramp down.
  const ramp = (t) => 0.5 * RAMP * Math.min(Math.max(t / RAMP, 0), 1) ** 2 + Math.max(t - RAMP, 0);
  const share = (line, t) => Math.min((ramp(t) - ramp(t - 1 / line.rate)) * line.rate, 1);
  const between = (line, s) => line.from.map((angle, j) => angle + s * (line.to[j] - angle));

  const indexAt = (time) => {
    let [low, high] = [0, visits.length - 1];
    while (low < high) {
      const middle = (low + high) >> 1;
      if (visits[middle].end <= time) low = middle + 1;
      else high = middle;
    }
    return low;
  };
  const alongCurve = (visit, since) => {
    const after = visit.times.findIndex((t) => t > since);
    if (after < 0) return visit.way[visit.way.length - 1];
    const [from, begin] = after ? [visit.way[after - 1], visit.times[after - 1]] : [visit.from, 0];
    return between({from, to: visit.way[after]}, (since - begin) / (visit.times[after] - begin));
  };
  const anglesAt = (visit, time) => {
    if (visit.times) return alongCurve(visit, Math.max(time - visit.begin, 0));
    const line = visit.lines.filter((l) => l.begin <= time).pop() || visit.lines[0];
    return between(line, share(line, Math.max(time - line.begin, 0)));
  };

  let view = null;
  const tips = (visit) => visit.times ? [visit.from, ...visit.way].map((q) => view.tip(q)) : visit.lines.flatMap((line) => {
    const steps = Math.max(2, Math.ceil(Math.max(...line.from.map((a, j) => Math.abs(line.to[j] - a))) / 0.08));
    return Array.from({length: steps + 1}, (_, i) => view.tip(between(line, i / steps)));
  });
  if (!RobotView.hasWebGL()) {
    element('no-webgl').hidden = false;
    element('scene').hidden = true;
    element('views').hidden = true;
  } else {
    view = new RobotView(element('scene'), plan.scene);
    const stops = visits.map((visit) => view.tip(visit.way[visit.way.length - 1]));
    view.showPath(visits.flatMap(tips), stops, visits.map((visit) => `--${visit.split}`));
    addEventListener('beforeprint', () => view.copyTo(element('printed')));
    for (const button of element('views').querySelectorAll('button')) {
      const from = button.dataset.from;
      button.addEventListener('click', () => view.look(/^\d+$/.test(from) ? Number(from) : from));
    }
  }
  element('loading').hidden = true;

  const clock = (seconds) => {
    const s = Math.floor(seconds);
    const parts = [Math.floor(s / 60) % 60, s % 60].map((n) => String(n).padStart(2, '0'));
    return s >= 3600 ? `${Math.floor(s / 3600)}:${parts.join(':')}` : parts.join(':');
  };
  // Degrees, or millimetres of a joint that slides.
  const shown = (value, j) => (value * (plan.scene.slides[j] ? 1000 : 180 / Math.PI)).toFixed(1).replace('-', '\u2212');

  // One bar a joint, between its limits.
  const bars = plan.scene.joints.map((name, j) => {
    const row = element('joints').insertRow();
    row.insertCell().textContent = name;
    const bar = document.createElement('i');
    const cell = row.insertCell();
    cell.className = 'bar';
    cell.append(bar);
    const angle = row.insertCell();
    angle.className = 'n';
    const low = plan.scene.lower[j] === null ? -Math.PI : plan.scene.lower[j];
    const high = plan.scene.upper[j] === null ? Math.PI : plan.scene.upper[j];
    return (q) => {
      bar.style.left = `${Math.min(Math.max((100 * (q[j] - low)) / (high - low), 0), 100)}%`;
      angle.textContent = `${shown(q[j], j)}${plan.scene.slides[j] ? ' mm' : '°'}`;
    };
  });

  const slider = element('time');
  slider.max = total;
  let time = 0;
  let playedVisit = -1;
  let playing = false;
  const show = () => {
    const index = indexAt(time);
    const visit = visits[index];
    const q = anglesAt(visit, time);
    const measuring = time >= visit.arrive;
    if (view && index !== playedVisit) view.showWay(tips(visit));
    if (view) view.pose(q, measuring);
    playedVisit = index;
    bars.forEach((update) => update(q));
    slider.value = time;
    const doing = measuring ? 'measured' : `${visit.times ? 'measured on the way' : 'on the way'}, at most ${visit.speed.toFixed(2)} m/s`;
    const state = `${index + 1} of ${visits.length}: ${words[visit.split]}, pose ${visit.pose + 1}, ${doing}`;
    element('state').textContent = state;
    element('clock').textContent = `${clock(time)} / ${clock(total)}`;
    slider.setAttribute('aria-valuetext', `${clock(time)}, ${state}`);
  };
  const goTo = (to) => {
    time = Math.min(Math.max(to, 0), total);
    show();
  };

  // A frame's time may lie before the click that began to play: the first one only sets the clock.
  let last = null;
  const tick = (now) => {
    if (!playing) return;
    goTo(time + ((now - (last ?? now)) / 1000) * Number(element('speed').value));
    last = now;
    if (time >= total) play(false);
    else requestAnimationFrame(tick);
  };
  const play = (on) => {
    playing = on;
    element('play').textContent = on ? 'Pause' : 'Play';
    if (!on) return;
    if (time >= total) time = 0;
    last = null;
    requestAnimationFrame(tick);
  };
  element('play').addEventListener('click', () => play(!playing));
  slider.addEventListener('input', () => goTo(Number(slider.value)));
  // To the configuration before and the next one, where it is measured.
  const step = (by) => {
    play(false);
    const at = indexAt(time);
    const to = by > 0 && time < visits[at].arrive ? at : at + by;
    goTo(visits[Math.min(Math.max(to, 0), visits.length - 1)].arrive);
  };
  element('before').addEventListener('click', () => step(-1));
  element('after').addEventListener('click', () => step(1));
  document.addEventListener('keydown', (event) => {
    if (event.key !== ' ' || event.target.closest('button, input, select, summary, a')) return;
    event.preventDefault();
    play(!playing);
  });

  // The list of all configurations, made when it is opened.
  element('all').addEventListener('toggle', () => {
    const body = element('visits');
    if (body.rows.length) return;
    visits.forEach((visit, i) => {
      const row = body.insertRow();
      const jump = document.createElement('a');
      jump.textContent = i + 1;
      jump.href = `#c${i + 1}`;
      row.insertCell().append(jump);
      const q = visit.way[visit.way.length - 1];
      const cells = [
        words[visit.split], visit.pose + 1, clock(visit.arrive), (visit.arrive - visit.begin).toFixed(1),
        visit.speed.toFixed(2), q.map(shown).join(', '),
      ];
      cells.forEach((text, column) => {
        const cell = row.insertCell();
        cell.textContent = text;
        if (column) cell.className = 'n';
      });
    });
  });
  // A link to #c12 shows configuration 12.
  const follow = () => {
    const number = /^#c(\d+)$/.exec(location.hash);
    const visit = number && visits[Number(number[1]) - 1];
    if (visit) {
      play(false);
      goTo(visit.arrive);
      element('view').scrollIntoView();
    }
    return visit;
  };
  addEventListener('hashchange', follow);
  if (!follow()) goTo(visits[0].arrive);
}
