'use strict';
// The pictures: the arm in 3-D, residuals and expected standard deviations.

const COLORS = ['#3b82c4', '#e07b39', '#2f9e78', '#a86bc0', '#c05b6b', '#8a8f3c', '#4fa3a8', '#808a96'];
const INK = '#808a96';
const GRID = 'rgba(128,138,150,0.35)';
let picture = null;
let lastScene = '';

function axis(title, more) {
  return { title: { text: title }, color: INK, gridcolor: GRID, zerolinecolor: GRID, ...more };
}

function plain(text) {
  // Plotly reads labels as a kind of HTML.
  return String(text).replaceAll('<', '‹').replaceAll('>', '›');
}

const SETTINGS = { displaylogo: false, responsive: true, displayModeBar: false };

// The arm (robot_view.js) with what is measured, and the pose that it goes to.
class LivePicture extends RobotView {
  constructor(place, scene) {
    super(place, scene);
    this.goal = new THREE.AxesHelper(0.15);
    this.goal.matrixAutoUpdate = false;
    this.goal.visible = false;
    this.measured = {};
    this.world.add(this.goal);
    // Where markers usually are: the picture does not jump as the arm moves.
    const r = scene.reach;
    this.spread = new THREE.Box3(new THREE.Vector3(-0.5 * r, -0.5 * r, 0), new THREE.Vector3(0.5 * r, 0.5 * r, 0.9 * r));
    this.look('arm');
  }

  show(view) {
    if (view.q) this.pose(view.q);
    this.goal.visible = view.target !== null;
    if (view.target) this.goal.matrix.set(...view.target);
    this.showWay(view.way.map((point) => new THREE.Vector3(...point)));
    Object.entries(view.points).forEach(([name, points], index) => this._showPoints(name, points, `--series${index % 4}`));
    this.scene.sights.forEach((sight, index) => this._placeSensor(index, view.sensors[sight.sensor]));
    this.draw();
  }

  _showPoints(name, points, color) {
    if (!this.measured[name]) {
      const dots = new THREE.PointsMaterial({ size: 5, sizeAttenuation: false });
      this._theme(dots, color);
      this.measured[name] = new THREE.Points(new THREE.BufferGeometry(), dots);
      this.measured[name].frustumCulled = false;
      this.world.add(this.measured[name]);
    }
    const old = this.measured[name].geometry;
    this.measured[name].geometry = new THREE.BufferGeometry().setFromPoints(points.map((p) => new THREE.Vector3(...p)));
    old.dispose();
  }

  // Lines of sight begin where the sensor was registered.
  _placeSensor(index, place) {
    if (!place) return;
    const points = this.sights[index].geometry.attributes.position;
    points.setXYZ(0, ...place);
    points.needsUpdate = true;
  }
}

function setScene(scene) {
  const notes = [...scene.notes];
  if (RobotView.hasWebGL()) {
    picture = new LivePicture(get('scene'), scene);
    const series = [...new Set(scene.sights.map((sight) => sight.sensor))];
    get('legend').replaceChildren('Drag to turn it. Blue line: the way of the tool. Points: ', ...series.flatMap((name, index) => {
      const dot = document.createElement('span');
      dot.className = `points${index % 4}`;
      dot.textContent = '\u25cf ';
      return [dot, `measured by ${name} `];
    }));
  } else {
    notes.push('No 3-D picture: this browser has no WebGL. Everything else works without it.');
    get('scene').hidden = true;
  }
  setText('scene-note', notes.join(' '));
}

function drawScene(view) {
  const key = JSON.stringify(view);
  if (!picture || document.hidden || key === lastScene) return;
  lastScene = key;
  picture.show(view);
}

function flat(id, made, layout) {
  get(id).hidden = made.length === 0;
  if (!made.length) return;
  const key = JSON.stringify(made);
  const element = get(id);
  if (element.dataset.key === key || document.hidden) return;
  element.dataset.key = key;
  Plotly.react(id, made, {
    paper_bgcolor: 'rgba(0,0,0,0)', plot_bgcolor: 'rgba(0,0,0,0)', font: { color: INK, size: 11 },
    margin: { l: 52, r: 8, t: 6, b: 40 }, legend: { orientation: 'h', y: 1.02, yanchor: 'bottom' }, ...layout,
  }, SETTINGS);
}

function drawResiduals(sensors) {
  const made = sensors.filter((s) => s.residuals_mm.length).map((s, index) => ({
    name: plain(s.name), y: s.residuals_mm, x: s.residuals_mm.map((_, i) => i + 1), mode: 'markers',
    marker: { size: 5, color: COLORS[index % COLORS.length], symbol: s.residuals_mm.map((_, i) => (i < s.of_registration ? 'circle-open' : 'circle')) },
  }));
  const registering = sensors.some((s) => s.of_registration);
  const model = sensors.some((s) => s.corrected) ? 'the arm with the fitted zero-offsets' : 'the nominal arm';
  setText('residuals-note', made.length
    ? `Distance from each measured marker to where ${model} has it, registered by all configurations so far. The fit itself weighs them by their noise.${registering ? ' Open circles: at the registration poses, which are not among the configurations counted above.' : ''}`
    : 'After five measured points.');
  flat('residuals', made, { xaxis: axis('measured points, in order'), yaxis: axis('mm', { rangemode: 'tozero' }), showlegend: true });
}

function drawPrecision(precision) {
  const made = Object.entries(precision.std_deg).filter(([, std]) => std.some((value) => value !== null))
    .map(([joint, std], index) => ({
      name: plain(joint), x: precision.configurations, y: std, customdata: precision.minutes, mode: 'lines+markers',
      line: { color: COLORS[index % COLORS.length] }, marker: { size: 4 },
      hovertemplate: '%{y:.4f}° after %{x} configurations, %{customdata:.1f} min',
    }));
  setText('precision-note', made.length
    ? `Of each zero-offset if the arm is exactly its drawing, by fits of what was recorded up to then; the last: ${precision.message}`
    : 'The optimizer fits what is recorded after every few configurations to fit.');
  const known = made.flatMap((one) => one.y.filter((value) => value > 0));
  // Over several decades only their powers of ten have room.
  const decades = known.length ? Math.log10(Math.max(...known) / Math.min(...known)) : 0;
  flat('precision', made.concat(made.length ? minutesTrace(precision) : []), {
    xaxis: axis('configurations to fit'), xaxis2: minutesAxis(precision), margin: { l: 52, r: 24, t: 24, b: 40 },
    yaxis: axis('std (°)', { type: 'log', tickformat: '~g', ...(decades > 1.5 ? { dtick: 1 } : {}) }), legend: { orientation: 'h', y: 1.14, yanchor: 'bottom' }, showlegend: true,
  });
}

// Minutes stand above the configurations after which they had passed; without times there is no such axis.
function minutesAxis(precision) {
  const timed = precision.minutes.map((_, i) => i).filter((i) => precision.minutes[i] !== null);
  const every = Math.max(1, Math.ceil(timed.length / 6));
  const shown = timed.filter((_, i) => (timed.length - 1 - i) % every === 0);
  return axis('', {
    side: 'top', overlaying: 'x', matches: 'x', showgrid: false, visible: timed.length > 0,
    tickmode: 'array', tickvals: shown.map((i) => precision.configurations[i]), ticktext: shown.map((i) => `${precision.minutes[i].toFixed(1)} min`),
  });
}

// An axis is drawn where it has a trace.
function minutesTrace(precision) {
  const std = Object.values(precision.std_deg).find((values) => values.some((value) => value !== null));
  return [{ x: precision.configurations, y: std, xaxis: 'x2', mode: 'markers', opacity: 0, hoverinfo: 'skip', showlegend: false }];
}
