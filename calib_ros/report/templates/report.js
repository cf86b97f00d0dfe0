'use strict';
(() => {
  const data = JSON.parse(document.getElementById('data').textContent);
  const narrow = () => window.innerWidth < 600;
  const INK = '#1b1f24', BEFORE = '#d95f02', AFTER = '#1b9e77', OUT = '#b3261e';
  let known;  // asked when it is needed: the first context takes a while
  const hasGL = () => (known ??= !!document.createElement('canvas').getContext('webgl'));
  const plain = { displayModeBar: false, responsive: true };
  const base = () => ({
    font: { color: INK, family: 'system-ui, sans-serif', size: 13 }, autosize: true,
    margin: { l: 60, r: 16, t: 30, b: 50 }, hovermode: 'closest',
    legend: { orientation: 'h', y: 1.02, yanchor: 'bottom', x: 0 },
  });

  // Figures are drawn when they come into view, the others when nothing else is to do: the page
  // opens at once, and a picture of all of it has them.
  const waiting = new Map();
  const watcher = new IntersectionObserver((seen) => {
    for (const each of seen) if (each.isIntersecting) draw(each.target.id);
  }, { rootMargin: '100px' });
  function draw(id) {
    const work = waiting.get(id);
    if (!work) return;
    waiting.delete(id);
    watcher.unobserve(document.getElementById(id));
    try { work(); } catch (error) {
      document.getElementById(id).textContent = 'This figure could not be drawn: ' + error.message;
      console.error(error);
    }
  }
  function later(id, work) {
    const place = document.getElementById(id);
    if (!place) return;
    waiting.set(id, work);
    watcher.observe(place);
  }
  const idle = window.requestIdleCallback || ((work) => setTimeout(work, 100));
  const next = () => {
    const [id] = waiting.keys();
    if (id) { draw(id); idle(next); }
  };
  window.addEventListener('load', () => idle(next));
  const fit = (width) => document.querySelectorAll('.js-plotly-plot').forEach((each) => Plotly.relayout(each, { width }));
  window.addEventListener('beforeprint', () => {
    [...waiting.keys()].forEach(draw);
    document.querySelectorAll('details').forEach((each) => { each.open = true; });
    fit(680);  // px, of a sheet: what is wider is cut
  });
  window.addEventListener('afterprint', () => fit(null));
  for (const [id, figure] of Object.entries(data.figures)) {
    later(id, () => {
      const layout = Object.assign(base(), figure.layout);
      if (narrow() && layout.margin.l > 130) layout.margin.l = 130;
      Plotly.newPlot(id, figure.data, layout, plain);
    });
  }
  if (!data.explorer) return;

  // Poses
  const e = data.explorer, n = e.joints.length;
  const floats = {};
  const unpacked = (text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer;
  for (const [name, text] of Object.entries(e.arrays)) floats[name] = new Float32Array(unpacked(text));
  const stamps = new BigInt64Array(unpacked(e.stamps)), count = stamps.length;
  const number = (i) => (e.number ? e.number[i] : i + 1);
  const source = (i) => {
    if (e.images[i]) return e.images[i];
    if (e.lines) return 'line ' + stamps[i] / 1000000000n;
    const ms = Number(stamps[i] / 1000000n);
    if (!e.clock) return `${(ms / 1000).toFixed(3)} s`;
    return new Date(ms).toISOString().replace('T', ' ').replace('Z', ' UTC');
  };
  const triple = (name, i) => [...floats[name].subarray(3 * i, 3 * i + 3)];
  const length = (v) => Math.hypot(v[0], v[1], v[2]);
  const lengths = {};
  for (const when of ['before', 'after']) {
    lengths[when] = Array.from({ length: count }, (_, i) => length(triple(when, i)));
  }
  const all = [...Array(count).keys()];
  const outliers = all.filter((i) => e.outlier[i]);
  const good = all.filter((i) => !e.outlier[i]);
  const state = { when: 'after', picked: -1, page: 0, component: 'length', rows: all };
  const byId = (id) => document.getElementById(id);
  const escaped = (text) => text.replaceAll('&', '&amp;').replaceAll('<', '&lt;');  // plotly reads tags
  const digitsFrom = (x) => (x < 1e-6 ? 3 : x < 100 ? Math.max(3, 1 - Math.floor(Math.log10(x))) : x < 999.95 ? 1 : 0);
  const digitsOf = (x) => digitsFrom(Math.abs(x));
  const fixed = (x, digits = digitsOf(x)) => (Number.isFinite(x) ? x.toFixed(digits) : '');
  const scale = () => Number((10 ** Number(byId('scale').value)).toPrecision(2));

  // Forward kinematics of the corrected arm, for the picture alone
  const product = (A, B) => A.map((row) => B[0].map((_, k) => row.reduce((s, x, j) => s + x * B[j][k], 0)));
  const turned = (k, t) => {
    const c = Math.cos(t), s = Math.sin(t), i = (k + 1) % 3, j = (k + 2) % 3;
    const m = [[0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0], [0, 0, 0, 1]];
    m[k][k] = 1; m[i][i] = c; m[j][j] = c; m[i][j] = -s; m[j][i] = s;
    return m;
  };
  const moved = (k, d) => {
    const m = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
    m[k][3] = d;
    return m;
  };
  const joints = floats.effective || floats.joints;
  function frames(i) {
    let T = moved(0, 0);
    const found = [T];
    e.table.forEach((row, k) => {
      let [a, alpha, d, theta, beta, b, sign, slides] = row;
      const q = sign * joints[n * i + k];
      if (slides) d += q; else theta += q;
      const drive = product(turned(2, theta), moved(2, d));
      const link = [moved(1, b), turned(0, alpha), turned(1, beta)].reduce(product, moved(0, a));
      T = product(T, e.convention === 'standard' ? product(drive, link) : product(link, drive));
      found.push(T);
    });
    found.push(product(T, e.tools[e.set[i]]));
    return found;
  }
  window.calibRos = { frames, state, position: (i) => triple('position', i) };  // for tests

  const GAP = [null, null, null];
  const xyz = (points) => ({ x: points.map((p) => p[0]), y: points.map((p) => p[1]), z: points.map((p) => p[2]) });
  function arm(i) {
    const found = frames(i).map((T) => T.slice(0, 3)), size = 0.12 * e.reach;
    const tip = (T, k) => T.map((row) => row[3] + size * row[k]), origin = (T) => T.map((row) => row[3]);
    const axes = [0, 1, 2].map((k) => xyz(found.flatMap((T) => [origin(T), tip(T, k), GAP])));
    return [xyz(found.map(origin)), axes];
  }

  function vectors() {
    const out = [], s = scale() * 1e-3;
    const total = e.cells ? e.cells.count.length : count;
    const step = Math.ceil(total / 4000);
    for (let i = 0; i < total; i += step) {
      const p = e.cells ? e.cells.position[i] : triple('position', i);
      const v = e.cells ? e.cells['mean_' + state.when][i] : triple(state.when, i);
      const drawn = Math.min(s, 0.5 * e.reach / (length(v) || 1));  // a gross error must not hide the arm
      out.push(p, p.map((x, k) => x + drawn * v[k]), GAP);
    }
    return xyz(out);
  }
  const errors = () => (e.cells ? e.cells['rms_' + state.when] : good.map((i) => lengths[state.when][i]));
  const words = (i) => `${source(i)}: ${fixed(lengths.before[i])} mm before, ${fixed(lengths.after[i])} mm after`;
  const at = (list) => xyz(list.map((i) => triple('position', i)));
  const dots = () => (e.cells
    ? { ...xyz(e.cells.position),
        text: e.cells.count.map((c, i) => `${c} ${e.things}, RMS ${fixed(e.cells.rms_before[i])} mm before, ${fixed(e.cells.rms_after[i])} mm after`) }
    : { ...at(good), text: good.map(words), customdata: good });
  const [POINTS, VECTORS, ARM, AXES, PICKED] = [0, 2, 3, 4, 7];

  function drawSpace() {
    const [line, axes] = arm(state.picked < 0 ? Math.floor(count / 2) : state.picked);
    const wide = { type: 'scatter3d', hoverinfo: 'skip', mode: 'lines', showlegend: false };
    const traces = [
      { type: 'scatter3d', mode: 'markers', name: e.things, ...dots(), hoverinfo: 'text',
        marker: { size: e.cells ? 2.5 : 3.5, color: errors(), colorscale: 'Viridis', reversescale: true, cmin: 0, cmax: e.largest[state.when],
          colorbar: { title: { text: 'error [mm]' }, thickness: 12, len: 0.7, ...(narrow() ? { orientation: 'h', len: 1, y: -0.2 } : {}) } } },
      { type: 'scatter3d', mode: 'markers', name: 'outliers', ...at(outliers), text: outliers.map((i) => 'outlier, ' + words(i)),
        customdata: outliers, hoverinfo: 'text', marker: { size: 5, symbol: 'diamond', color: OUT } },
      { ...wide, ...vectors(), line: { color: '#6e7781', width: 2 }, name: 'errors' },
      { ...wide, ...line, mode: 'lines+markers', line: { color: '#333', width: 10 }, marker: { size: 5, color: '#333' } },
      ...axes.map((axis, k) => ({ ...wide, ...axis, line: { color: ['#c00', '#070', '#03c'][k], width: 4 } })),
      { type: 'scatter3d', mode: 'markers', ...at(state.picked < 0 ? [] : [state.picked]), hoverinfo: 'skip',
        marker: { size: 11, symbol: 'circle-open', color: '#000', line: { width: 3 } }, showlegend: false },
    ];
    const layout = base(), far = narrow() ? 1.6 : 1.35;
    const title = (text) => ({ title: { text: text + ' [m]' } });
    layout.scene = { aspectmode: 'data', xaxis: title('x'), yaxis: title('y'), zaxis: title('z'), camera: { eye: { x: 1.2 * far, y: -1.2 * far, z: 0.5 * far }, center: { x: 0, y: 0, z: -0.15 } } };
    layout.margin = { l: 0, r: 0, t: 30, b: 0 };
    layout.showlegend = outliers.length > 0;
    Plotly.newPlot('space', traces, layout, plain);
    byId('space').on('plotly_click', (event) => {
      const point = event.points[0];
      if (point.customdata !== undefined) pick(point.customdata);
      else if (e.cells && point.curveNumber === POINTS) byId('picked').textContent = point.text;
    });
  }
  const drawn = (id) => !waiting.has(id) && byId(id).data;

  function update() {
    byId('scale-value').textContent = scale() + ' ×';
    if (!drawn('space')) return;
    Plotly.restyle('space', { 'marker.color': [errors()], 'marker.cmax': e.largest[state.when] }, [POINTS]);
    const v = vectors();
    Plotly.restyle('space', { x: [v.x], y: [v.y], z: [v.z] }, [VECTORS]);
  }

  function pick(i, fromTable = false) {
    state.picked = i;
    if (!fromTable) {
      let place = state.rows.indexOf(i);
      if (place < 0) { byId('only').checked = false; byId('sort').value = 'order'; arrange(); place = state.rows.indexOf(i); }
      state.page = Math.floor(place / SIZE);
    }
    list();
    byId('picked').textContent = `Picked: ${source(i)}, error ${fixed(lengths.before[i])} mm before, ${fixed(lengths.after[i])} mm after` + (e.outlier[i] ? '; an outlier.' : '.');
    if (!drawn('space')) return;
    const [line, axes] = arm(i), mark = at([i]);
    const parts = [line, ...axes, mark];
    Plotly.restyle('space', { x: parts.map((p) => p.x), y: parts.map((p) => p.y), z: parts.map((p) => p.z) },
      [ARM, AXES, AXES + 1, AXES + 2, PICKED]);
  }

  // The list
  const SIZE = 12;
  const sized = floats.size.some(Number.isFinite), roles = new Set(e.role).size > 1 || outliers.length > 0;
  const columns = [
    ['before [mm]', (i) => fixed(lengths.before[i])], ['after [mm]', (i) => fixed(lengths.after[i])],
    roles && ['used', (i) => e.roles[e.role[i]] + (e.outlier[i] ? ', outlier' : '')],
    e.oriented && ['before [mrad]', (i) => fixed(floats.turned_before[i])],
    e.oriented && ['after [mrad]', (i) => fixed(floats.turned_after[i])],
    sized && ['residual/typical error', (i) => fixed(floats.size[i], 1)],
    ...e.joints.map((name, k) => [`${name} [${e.show[k][1]}]`, (i) => fixed(floats.joints[n * i + k] * e.show[k][0], e.show[k][2])]),
  ].filter(Boolean);
  const isNumber = ([title]) => title !== 'used';
  function cell(row, text, number = true) {
    const td = row.insertCell();
    td.textContent = text;
    if (number) td.className = 'n';
    return td;
  }
  function arrange() {
    state.rows = byId('only').checked ? [...outliers] : [...all];
    const by = byId('sort').value;
    if (by !== 'order') state.rows.sort((a, b) => lengths[by][b] - lengths[by][a]);
    state.page = 0;
  }
  function list() {
    const pages = Math.max(1, Math.ceil(state.rows.length / SIZE));
    const body = byId('rows').tBodies[0];
    body.replaceChildren();
    for (const i of state.rows.slice(SIZE * state.page, SIZE * (state.page + 1))) {
      const row = body.insertRow();
      row.className = i === state.picked ? 'picked' : e.outlier[i] ? 'outlier' : '';
      const button = document.createElement('button');
      button.type = 'button';
      button.textContent = source(i);
      button.setAttribute('aria-label', `Show ${e.things.slice(0, -1)} ${source(i)} in the figure`);
      button.addEventListener('click', () => { pick(i, true); byId('rows').querySelector('.picked button').focus(); });
      cell(row, '', false).append(button);
      for (const each of columns) cell(row, each[1](i), isNumber(each));
    }
    byId('page').textContent = `${state.page + 1} of ${pages}`;
    byId('previous').disabled = state.page === 0;
    byId('next').disabled = state.page >= pages - 1;
  }
  const headRow = byId('rows').tHead.insertRow();
  for (const each of [[e.things.slice(0, -1)], ...columns]) {
    const th = document.createElement('th');
    th.textContent = each[0];
    if (each[1] && isNumber(each)) th.className = 'n';
    headRow.append(th);
  }
  byId('only').parentElement.hidden = !outliers.length;
  byId('sized').hidden = !sized;

  // Errors over the session and against each joint
  for (const [value, text] of e.kinds) byId('component').add(new Option(text, value));
  const AXIS = { x: 0, y: 1, z: 2 };
  const value = (when, i) => (state.component === 'length' ? lengths[when][i]
    : state.component === 'angle' ? floats['turned_' + when][i]
      : floats[when][3 * i + AXIS[state.component]]);
  const label = () => e.kinds.find(([v]) => v === state.component)[1];
  const first = () => Number(byId('alone').checked);
  function series(xs, key, axis) {
    if (e.bins) return bands(e.bins[key][state.component], axis);
    const type = count > 2000 && hasGL() ? 'scattergl' : 'scatter';
    const one = (when, list, more) => ({
      type, mode: 'markers', x: list.map(xs), y: list.map((i) => value(when, i)), customdata: list,
      text: list.map((i) => `${source(i)}<br>${fixed(value(when, i))}`), hovertemplate: '%{text}<extra></extra>',
      ...axis, ...more });
    const found = [
      one('before', good, { name: 'before', marker: { color: BEFORE, size: 4, symbol: 'diamond', opacity: 0.6 } }),
      one('after', good, { name: 'after', marker: { color: AFTER, size: 4, opacity: 0.8 } }),
    ].slice(first());
    if (!outliers.length) return found;
    const shown = found.flatMap((each) => each.y).filter(Number.isFinite);
    const low = shown.reduce((a, b) => Math.min(a, b), 0), high = shown.reduce((a, b) => Math.max(a, b), 0);
    const far = outliers.map((i) => Math.max(2 * low - high, Math.min(2 * high - low, value('after', i))));
    const name = outliers.some((i, k) => far[k] !== value('after', i)) ? 'outliers, far ones drawn nearer' : 'outliers';
    found.push(one('after', outliers, { name, y: far, marker: { color: OUT, size: 9, symbol: 'x' } }));
    return found;
  }
  function bands(bin, axis) {
    const found = [];
    for (const [when, colour, fill] of [['before', BEFORE, 'rgba(217,95,2,.18)'], ['after', AFTER, 'rgba(27,158,119,.25)']].slice(first())) {
      const [low, middle, high] = bin[when];
      const line = { mode: 'lines', type: 'scatter', hoverinfo: 'skip', ...axis };
      found.push({ ...line, x: bin.x, y: low, line: { width: 0 }, showlegend: false });
      found.push({ ...line, x: bin.x, y: high, fill: 'tonexty', fillcolor: fill, line: { width: 0 }, showlegend: false });
      found.push({ ...line, x: bin.x, y: middle, name: when + ': median, 5 to 95 %', line: { color: colour, width: 2 }, hoverinfo: 'x+y' });
    }
    return found;
  }
  const drawTraces = (id, traces, layout) => Plotly.react(id, traces, layout, plain).then(() => {
    byId(id).removeAllListeners('plotly_click');
    byId(id).on('plotly_click', ({ points: [{ customdata: i }] }) => { if (i !== undefined) pick(i); });
  });
  function drawSession() {
    const layout = base();
    layout.xaxis = { title: { text: e.things + ' in order' } };
    layout.yaxis = { title: { text: label() }, rangemode: 'tozero' };
    drawTraces('session', series(number, 'session', {}), layout);
  }
  function drawJoints() {
    const columns = narrow() ? 1 : Math.min(3, n), rows = Math.ceil(n / columns);
    byId('joints').style.height = `${60 + 230 * rows}px`;
    const layout = base(), traces = [];
    layout.grid = { rows, columns, pattern: 'independent', xgap: 0.12, ygap: 0.3 };
    layout.height = 60 + 230 * rows;
    for (let k = 0; k < n; k++) {
      const s = k ? String(k + 1) : '';
      layout['xaxis' + s] = { title: { text: `${escaped(e.joints[k])} [${e.show[k][1]}]`, standoff: 2 } };
      layout['yaxis' + s] = { rangemode: 'tozero', ...(k % columns ? {} : { title: { text: label() } }) };
      series((i) => floats.joints[n * i + k] * e.show[k][0], 'joint' + k, { xaxis: 'x' + s, yaxis: 'y' + s })
        .forEach((trace) => traces.push({ ...trace, showlegend: k === 0 && trace.showlegend !== false }));
    }
    drawTraces('joints', traces, layout);
  }

  later('space', () => {
    if (hasGL()) drawSpace();
    else byId('space').textContent = 'This browser draws nothing in 3-D (no WebGL). The list and the other figures show the same.';
  });
  later('session', drawSession);
  later('joints', drawJoints);
  for (const each of document.querySelectorAll('input[name=when]')) {
    each.addEventListener('change', () => { state.when = each.value; update(); });
  }
  byId('scale').addEventListener('input', update);
  for (const id of ['sort', 'only']) byId(id).addEventListener('change', () => { arrange(); list(); });
  byId('previous').addEventListener('click', () => { state.page -= 1; list(); });
  byId('next').addEventListener('click', () => { state.page += 1; list(); });
  for (const id of ['component', 'alone']) byId(id).addEventListener('change', () => {
    state.component = byId('component').value;
    if (drawn('session')) drawSession();
    if (drawn('joints')) drawJoints();
  });
  for (const button of document.querySelectorAll('[data-turn]')) {
    button.addEventListener('click', () => {
      if (!drawn('space')) return;
      const scene = byId('space')._fullLayout.scene._scene;
      const eye = (scene ? scene.getCamera() : byId('space').layout.scene.camera).eye;
      const flat = Math.hypot(eye.x, eye.y), size = Math.hypot(flat, eye.z);
      let around = Math.atan2(eye.y, eye.x), up = Math.atan2(eye.z, flat);
      around += { left: -0.3, right: 0.3 }[button.dataset.turn] || 0;
      up = Math.max(-1.5, Math.min(1.5, up + ({ up: 0.2, down: -0.2 }[button.dataset.turn] || 0)));
      Plotly.relayout('space', { 'scene.camera.eye': {
        x: size * Math.cos(up) * Math.cos(around), y: size * Math.cos(up) * Math.sin(around), z: size * Math.sin(up) } });
    });
  }
  byId('scale').value = e.enlarge;
  arrange();
  list();
  update();
})();
