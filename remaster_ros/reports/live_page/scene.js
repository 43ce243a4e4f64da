'use strict';
// The pictures: the arm in 3-D, residuals and expected standard deviations.

const COLORS = ['#3b82c4', '#e07b39', '#2f9e78', '#a86bc0', '#c05b6b', '#8a8f3c', '#4fa3a8', '#808a96'];
const INK = '#808a96';
const GRID = 'rgba(128,138,150,0.35)';
let fixed = null;
let traces = null;
let lastScene = '';
let scenePending = false;

function axis(title, more) {
  return { title: { text: title }, color: INK, gridcolor: GRID, zerolinecolor: GRID, ...more };
}

function plain(text) {
  // Plotly reads labels as a kind of HTML.
  return String(text).replaceAll('<', '‹').replaceAll('>', '›');
}

const SETTINGS = { displaylogo: false, responsive: true, displayModeBar: false };

function setScene(content) {
  fixed = content;
  lastScene = '';
}

// Corners of a surface, moved by the transform (16 numbers, by rows) of its link.
function placed(surface, frame) {
  const out = [[], [], []];
  for (const [x, y, z] of surface.vertices) {
    for (let row = 0; row < 3; row += 1) {
      const at = 4 * row;
      out[row].push(frame[at] * x + frame[at + 1] * y + frame[at + 2] * z + frame[at + 3]);
    }
  }
  return out;
}

function line(points, more) {
  return {
    type: 'scatter3d', x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]), ...more,
  };
}

function axesOf(matrix, length) {
  const origin = [matrix[3], matrix[7], matrix[11]];
  const points = [];
  for (let column = 0; column < 3; column += 1) {
    const end = origin.map((value, row) => value + length * matrix[4 * row + column]);
    points.push(origin, end, [null, null, null]);
  }
  return points;
}

function sceneTraces(scene) {
  const made = fixed.surfaces.map((surface) => {
    const frame = scene.frames[surface.link] || scene.frames[0] || [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0];
    const [x, y, z] = placed(surface, frame);
    return {
      type: 'mesh3d', name: plain(surface.name), x, y, z,
      i: surface.faces.map((f) => f[0]), j: surface.faces.map((f) => f[1]), k: surface.faces.map((f) => f[2]),
      color: surface.color, flatshading: true, opacity: surface.role === 'obstacle' ? 0.35 : 1,
      visible: scene.frames.length > 0 || surface.link === 0,
      hoverinfo: 'name', showlegend: false,
    };
  });
  made.push(line(scene.way, {
    mode: 'lines', name: 'way of the tool', line: { color: '#e0a83c', width: 5 }, hoverinfo: 'skip',
  }));
  made.push(line(scene.target ? axesOf(scene.target, 0.12) : [], {
    mode: 'lines', name: 'pose it goes to', line: { color: '#c0392b', width: 6 }, hoverinfo: 'skip',
  }));
  Object.entries(scene.points).forEach(([name, points], index) => made.push(line(points, {
    mode: 'markers', name: `measured by ${plain(name)}`, marker: { size: 2.5, color: COLORS[index % COLORS.length] },
    hoverinfo: 'name',
  })));
  return made;
}

async function drawScene(scene) {
  const key = JSON.stringify(scene);
  if (!fixed || scenePending || document.hidden || key === lastScene) return;
  lastScene = key;
  scenePending = true;
  try {
    const made = sceneTraces(scene);
    if (!traces) {
      traces = made;
      await Plotly.newPlot('scene', made, {
        scene: {
          xaxis: axis('x (m)', { showbackground: false, range: [-fixed.reach_m, fixed.reach_m] }),
          yaxis: axis('y (m)', { showbackground: false, range: [-fixed.reach_m, fixed.reach_m] }),
          zaxis: axis('z (m)', { showbackground: false, range: [Math.min(fixed.lowest_m, 0), fixed.reach_m] }),
          aspectmode: 'data', camera: { eye: { x: 1.05, y: 1.05, z: 0.45 }, center: { x: 0, y: 0, z: -0.05 } },
        },
        uirevision: 'kept', paper_bgcolor: 'rgba(0,0,0,0)', font: { color: INK }, margin: { l: 0, r: 0, t: 0, b: 0 },
        legend: { orientation: 'h', y: 0, yanchor: 'top' },
      }, SETTINGS);
      setText('scene-note', fixed.notes.join(' '));
    } else {
      await Plotly.restyle('scene', {
        x: made.map((t) => t.x), y: made.map((t) => t.y), z: made.map((t) => t.z),
        visible: made.map((t) => t.visible !== false),
      });
    }
  } catch (error) {
    setText('scene-note', 'No 3-D picture: this browser shows no WebGL. Everything else works without it.');
  }
  scenePending = false;
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
    marker: { size: 5, color: COLORS[index % COLORS.length] },
  }));
  const model = sensors.some((s) => s.corrected) ? 'the arm with the fitted zero-offsets' : 'the nominal arm';
  setText('residuals-note', made.length
    ? `Distance from each measured marker to where ${model} has it, registered by all configurations so far.`
    : 'After five recorded configurations.');
  flat('residuals', made, { xaxis: axis('configuration since this page was started'), yaxis: axis('mm', { rangemode: 'tozero' }), showlegend: true });
}

function drawPrecision(precision) {
  const made = Object.entries(precision.std_deg).filter(([, std]) => std.some((value) => value !== null))
    .map(([joint, std], index) => ({
      name: plain(joint), x: precision.configurations, y: std, customdata: precision.minutes, mode: 'lines+markers',
      line: { color: COLORS[index % COLORS.length] }, marker: { size: 4 },
      hovertemplate: '%{y:.4f}° after %{x} configurations, %{customdata:.1f} min',
    }));
  setText('precision-note', made.length
    ? 'Of each zero-offset, for what is recorded so far to be fitted, at the noise that the cell file expects.'
    : 'As soon as a configuration to be fitted is recorded.');
  flat('precision', made, { xaxis: axis('configurations to fit'), yaxis: axis('std (°)', { type: 'log' }), showlegend: true });
}
