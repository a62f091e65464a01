(() => {
'use strict';
const $ = id => document.getElementById(id);
const data = JSON.parse($('story').textContent);
const player = $('player');
if (!player) return;

// What the numbers are made of.
const unpack = (text, Kind) => new Kind(Uint8Array.from(atob(text), c => c.charCodeAt(0)).buffer);
const F = text => text ? unpack(text, Float32Array) : null;
const bearings = F(data.bearings), beams = bearings.length;
const drives = data.drives.map(d => {
  const counts = unpack(d.hypotheses.counts, Uint16Array), starts = [0];
  counts.forEach(n => starts.push(starts[starts.length - 1] + n));
  return {
    ...d, stamps: F(d.stamps), estimates: F(d.estimates), truth: F(d.truth), error: F(d.errorPosition),
    turn: F(d.errorHeading), lost: F(d.lost), verdict: unpack(d.verdict, Uint8Array),
    ranges: unpack(d.ranges, Uint16Array), places: F(d.hypotheses.rows), starts,
    xy: unpack(d.particles.xy, Int16Array), headings: unpack(d.particles.turn, Uint8Array),
    weights: unpack(d.particles.weight, Uint8Array), particles: d.particles.count,
  };
});
const NAMES = { localized: 'localized', ambiguous: 'ambiguous', off_map: 'off the map', lost: 'lost' };
const WHY = {
  localized: 'One place explains what was seen.',
  ambiguous: 'Several places explain it: do not drive on this answer.',
  off_map: 'No place on this map explains it.',
  lost: 'The answer is not to be trusted.',
};
// Shapes differ as well as colours.
const HEIGHT = { localized: 0.3, ambiguous: 0.55, off_map: 0.8, lost: 1 };

const state = { drive: 0, t: 0, playing: false, follow: false, zoom: 1, centre: null, drag: null };
const drive = () => drives[state.drive];
const count = () => drives.length ? drive().stamps.length : 0;
const pose = (list, t) => list.subarray(3 * t, 3 * t + 3);
const known = p => p && Number.isFinite(p[0]);
let colours = {};
const readColours = () => {
  const style = getComputedStyle(document.documentElement);
  for (const name of ['ink', 'quiet', 'line', 'paper', 'unknown', 'free', 'wall', 'estimate', 'truth', 'hypotheses',
    'scan', 'particles', 'localized', 'ambiguous', 'off_map', 'lost']) colours[name] = style.getPropertyValue('--' + name).trim();
};

// The map, in the colours of the theme.
const images = {};
const load = (name, source) => source && Object.assign(new Image(), {
  src: source.png, onload() { images[name] = { pixels: this, ...source }; tint(); draw(); },
});
const rgb = colour => {
  const hex = colour.length === 4 ? [...colour.slice(1)].map(c => c + c).join('') : colour.slice(1);
  return [0, 2, 4].map(n => parseInt(hex.slice(n, n + 2), 16));
};
const CIVIDIS = ['#00224e', '#35456c', '#666970', '#948e77', '#c8b866', '#fee838'].map(rgb);
const tint = () => {
  const shade = { 0: rgb(colours.unknown), 128: rgb(colours.free), 255: rgb(colours.wall) };
  paint(images.map, v => [...shade[v], 255]);
  paint(images.overlay, v => {
    if (!v) return [0, 0, 0, 0];
    const at = (v - 1) / 254 * (CIVIDIS.length - 1), low = Math.min(Math.floor(at), CIVIDIS.length - 2);
    return [...CIVIDIS[low].map((c, n) => c + (CIVIDIS[low + 1][n] - c) * (at - low)), 230];
  });
};
const paint = (image, colourOf) => {
  if (!image) return;
  const canvas = document.createElement('canvas');
  [canvas.width, canvas.height] = [image.pixels.width, image.pixels.height];
  const context = canvas.getContext('2d');
  context.drawImage(image.pixels, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height), values = pixels.data;
  for (let n = 0; n < values.length; n += 4) values.set(colourOf(values[n]), n);
  context.putImageData(pixels, 0, 0);
  image.tinted = canvas;
};

// A canvas as sharp as the screen.
const sized = canvas => {
  const ratio = window.devicePixelRatio || 1, box = canvas.getBoundingClientRect();
  const [w, h] = [Math.max(1, Math.round(box.width * ratio)), Math.max(1, Math.round(box.height * ratio))];
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, box.width, box.height);
  return [context, box.width, box.height];
};
const [x0, y0, x1, y1] = data.view;
const viewpoint = (w, h) => {
  const fit = Math.min(w / (x1 - x0), h / (y1 - y0)) * 0.96;
  const here = drives.length && state.follow ? pose(drive().estimates, state.t) : null;
  const centre = known(here) ? [here[0], here[1]] : state.centre || [(x0 + x1) / 2, (y0 + y1) / 2];
  return { scale: fit * state.zoom, centre };
};
const shown = name => !$('layer-' + name) || $('layer-' + name).checked;

const drawMap = () => {
  const [context, w, h] = sized($('map')), view = viewpoint(w, h), k = view.scale;
  const X = x => (x - view.centre[0]) * k + w / 2, Y = y => h / 2 - (y - view.centre[1]) * k;
  for (const image of [images.map, images.overlay]) {
    if (!image || !image.tinted) continue;
    const [x, y, turn] = image.origin, cell = image.resolution * k;
    context.save();
    context.imageSmoothingEnabled = cell < 1;
    context.translate(X(x), Y(y));
    context.rotate(-turn);
    context.drawImage(image.tinted, 0, -image.tinted.height * cell, image.tinted.width * cell, image.tinted.height * cell);
    context.restore();
  }
  data.lookalikes.forEach((pair, n) => drawPair(context, X, Y, pair, n + 1));
  if (drives.length) drawMoment(context, X, Y, k);
  scaleBar(k);
};
const drawMoment = (context, X, Y, k) => {
  const d = drive(), t = state.t, here = pose(d.estimates, t), real = d.truth && pose(d.truth, t);
  if (shown('path')) {
    if (d.truth && shown('truth')) path(context, X, Y, d.truth, d, count(), colours.truth, 1.5, 0.45, [5, 4]);
    if (shown('estimate')) {
      path(context, X, Y, d.estimates, d, count(), colours.estimate, 1.5, 0.25, []);
      path(context, X, Y, d.estimates, d, t + 1, colours.estimate, 2.5, 0.9, []);
    }
  }
  if (shown('particles')) drawParticles(context, X, Y, d, t, k);
  if (shown('scan') && known(here)) drawScan(context, X, Y, d, t, here);
  if (shown('hypotheses')) for (const row of places(d, t)) drawPlace(context, X, Y, k, row);
  if (known(real) && shown('truth')) robot(context, X, Y, real, colours.truth, true);
  if (known(here) && shown('estimate')) robot(context, X, Y, here, colours.estimate, false);
};
const path = (context, X, Y, list, d, until, colour, width, opacity, dash) => {
  context.save();
  Object.assign(context, { strokeStyle: colour, lineWidth: width, globalAlpha: opacity, lineJoin: 'round' });
  context.setLineDash(dash);
  context.beginPath();
  let before = null;
  for (let n = 0; n < until; n++) {
    const p = pose(list, n);
    if (!known(p)) { before = null; continue; }
    // Where it was carried, or jumped to another place, no line was driven.
    const far = before && Math.hypot(p[0] - before[0], p[1] - before[1]) > 3;
    if (!before || far || d.kidnapped.includes(n)) context.moveTo(X(p[0]), Y(p[1]));
    else context.lineTo(X(p[0]), Y(p[1]));
    before = p;
  }
  context.stroke();
  context.restore();
};
const drawParticles = (context, X, Y, d, t, k) => {
  const q = data.quantum, n = d.particles, size = Math.max(2, Math.min(4, k * 0.08));
  context.fillStyle = colours.particles;
  for (let m = t * n; m < (t + 1) * n; m++) {
    context.globalAlpha = 0.25 + 0.6 * d.weights[m] / 255;
    const x = X(q.x + d.xy[2 * m] * q.scale), y = Y(q.y + d.xy[2 * m + 1] * q.scale);
    context.fillRect(x - size / 2, y - size / 2, size, size);
    if (k > 25) {
      const turn = d.headings[m] / 256 * 2 * Math.PI;
      context.strokeStyle = colours.particles;
      context.beginPath(); context.moveTo(x, y); context.lineTo(x + 9 * Math.cos(turn), y - 9 * Math.sin(turn)); context.stroke();
    }
  }
  context.globalAlpha = 1;
};
const drawScan = (context, X, Y, d, t, here) => {
  const c = Math.cos(here[2]), s = Math.sin(here[2]);
  const mx = here[0] + c * data.mount[0] - s * data.mount[1], my = here[1] + s * data.mount[0] + c * data.mount[1];
  context.fillStyle = colours.scan;
  for (let b = 0; b < beams; b++) {
    const code = d.ranges[t * beams + b];
    if (code === 65535) continue;
    const r = code * data.range, a = here[2] + bearings[b];
    context.beginPath();
    context.arc(X(mx + r * Math.cos(a)), Y(my + r * Math.sin(a)), 2.2, 0, 2 * Math.PI);
    context.fill();
  }
};
const places = (d, t) => {
  const rows = [];
  for (let n = d.starts[t]; n < d.starts[t + 1]; n++) rows.push(d.places.subarray(8 * n, 8 * n + 8));
  return rows.sort((a, b) => b[0] - a[0]);
};
const drawPlace = (context, X, Y, k, [weight, x, y, theta, xx, xy, yy]) => {
  // Two standard deviations; the axes of a 2 x 2 covariance.
  const mid = (xx + yy) / 2, gap = Math.hypot((xx - yy) / 2, xy), turn = Math.atan2(2 * xy, xx - yy) / 2;
  const [a, b] = [mid + gap, Math.max(mid - gap, 0)].map(v => Math.max(2 * Math.sqrt(v) * k, 9));
  context.save();
  Object.assign(context, { strokeStyle: colours.hypotheses, fillStyle: colours.hypotheses, lineWidth: 1 + 2 * weight });
  context.setLineDash([5, 3]);
  context.beginPath();
  context.ellipse(X(x), Y(y), a, b, -turn, 0, 2 * Math.PI);
  context.globalAlpha = 0.10 + 0.12 * weight; context.fill();
  context.globalAlpha = 1; context.stroke();
  context.setLineDash([]);
  context.beginPath(); context.moveTo(X(x), Y(y));
  context.lineTo(X(x) + (a + 6) * Math.cos(theta), Y(y) - (a + 6) * Math.sin(theta)); context.stroke();
  if (weight < 0.985) tag(context, `${Math.round(100 * weight)} %`, X(x) + a + 6, Y(y) - 8, colours.hypotheses);
  context.restore();
};
const tag = (context, text, x, y, colour) => {
  context.save();
  context.font = '600 12px system-ui, sans-serif';
  Object.assign(context, { lineWidth: 4, strokeStyle: colours.paper, fillStyle: colour, lineJoin: 'round' });
  context.strokeText(text, x, y); context.fillText(text, x, y);
  context.restore();
};
const robot = (context, X, Y, [x, y, theta], colour, hollow) => {
  context.save();
  context.translate(X(x), Y(y));
  context.rotate(-theta);
  Object.assign(context, { strokeStyle: hollow ? colour : colours.paper, fillStyle: colour, lineWidth: hollow ? 3 : 2, lineJoin: 'round' });
  context.beginPath();
  if (hollow) {
    context.arc(0, 0, 12, 0, 2 * Math.PI); context.moveTo(12, 0); context.lineTo(22, 0); context.stroke();
  } else {
    context.moveTo(14, 0); context.lineTo(-9, 8); context.lineTo(-5, 0); context.lineTo(-9, -8); context.closePath();
    context.stroke(); context.fill();
  }
  context.restore();
};
const drawPair = (context, X, Y, pair, number) => {
  for (const [end, hollow] of [[pair.a, false], [pair.b, true]]) {
    robot(context, X, Y, end, hollow ? colours.truth : colours.estimate, hollow);
    tag(context, `${number}${hollow ? 'b' : 'a'}`, X(end[0]) + 13, Y(end[1]) - 11, hollow ? colours.truth : colours.estimate);
  }
};
const scaleBar = k => {
  const metres = [0.5, 1, 2, 5, 10, 20, 50, 100].find(m => m * k > 60) || 200;
  $('scale').firstElementChild.style.width = `${metres * k}px`;
  $('scale').lastElementChild.textContent = `${metres} m`;
};

// Charts over the updates; 38 px on the left for their scales.
const LEFT = 38, RIGHT = 8;
const across = (w, t) => LEFT + (w - LEFT - RIGHT) * (count() > 1 ? t / (count() - 1) : 0.5);
const chart = (canvas, values, toShare, ticks, limit, limitSays, colour) => {
  const [context, w, h] = sized(canvas), top = 6, foot = h - 14;
  const Y = v => foot - (foot - top) * toShare(v);
  context.font = '11px system-ui, sans-serif';
  context.textBaseline = 'middle';
  for (const [value, text] of ticks) {
    context.strokeStyle = colours.line; context.lineWidth = 1;
    context.beginPath(); context.moveTo(LEFT, Y(value)); context.lineTo(w - RIGHT, Y(value)); context.stroke();
    context.fillStyle = colours.quiet; context.textAlign = 'right'; context.fillText(text, LEFT - 6, Y(value));
  }
  strip(context, w, foot + 3, h - foot - 3);
  context.save();
  context.setLineDash([4, 4]); context.strokeStyle = colours.quiet;
  context.beginPath(); context.moveTo(LEFT, Y(limit)); context.lineTo(w - RIGHT, Y(limit)); context.stroke();
  context.restore();
  for (const t of drive().kidnapped) {
    context.strokeStyle = colours.ink; context.lineWidth = 1;
    context.beginPath(); context.moveTo(across(w, t), top); context.lineTo(across(w, t), foot); context.stroke();
    if (canvas.id === 'chart-lost') tag(context, 'carried away', across(w, t) + 4, top + 6, colours.ink);
  }
  Object.assign(context, { strokeStyle: colour, fillStyle: colour, lineWidth: 2, lineJoin: 'round' });
  context.beginPath();
  let pen = false;
  values.forEach((v, t) => {
    if (!Number.isFinite(v)) { pen = false; return; }
    if (pen) context.lineTo(across(w, t), Y(v)); else context.moveTo(across(w, t), Y(v));
    pen = true;
  });
  context.stroke();
  if (w > 560) tag(context, limitSays, w - RIGHT - 4 - context.measureText(limitSays).width * 1.1, Y(limit) - 8, colours.quiet);
  context.strokeStyle = colours.ink; context.lineWidth = 1.5;
  context.beginPath(); context.moveTo(across(w, state.t), 2); context.lineTo(across(w, state.t), h); context.stroke();
  const v = values[state.t];
  if (Number.isFinite(v)) { context.beginPath(); context.arc(across(w, state.t), Y(v), 4, 0, 2 * Math.PI); context.fill(); }
};
const strip = (context, w, y, h) => {
  const half = (across(w, 1) - across(w, 0)) / 2 || 4;
  drive().verdict.forEach((v, t) => {
    const name = data.verdicts[v], tall = h * HEIGHT[name];
    context.fillStyle = colours[name];
    context.fillRect(across(w, t) - half, y + h - tall, 2 * half + 0.5, tall);
  });
};
const logShare = v => Math.min(1, Math.max(0, (Math.log10(Math.max(v, 0.01)) + 2) / 3.5));
const drawCharts = () => {
  const d = drive();
  chart($('chart-lost'), d.lost, v => Math.min(1, Math.max(0, v)), [[0, '0'], [0.5, '½'], [1, '1']], 0.05, 'sure below 5 %', colours.lost);
  if (d.truth) chart($('chart-error'), d.error, logShare, [[0.01, '0.01'], [0.1, '0.1'], [1, '1'], [10, '10']], 2, 'right place below 2 m', colours.truth);
};

// Words.
const percent = v => v < 0.001 ? '< 0.1 %' : v > 0.999 && v < 1 ? '> 99.9 %' : `${(100 * v).toFixed(1)} %`;
const metres = v => v < 1 ? `${(100 * v).toFixed(0)} cm` : `${v.toFixed(1)} m`;
const degrees = v => `${(v * 180 / Math.PI).toFixed(0)}°`;
const clock = s => `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, '0')}`;
const tell = () => {
  const d = drive(), t = state.t, verdict = data.verdicts[d.verdict[t]], here = pose(d.estimates, t);
  $('verdict-name').textContent = NAMES[verdict];
  $('verdict').style.setProperty('--tone', `var(--${verdict})`);
  $('verdict-why').textContent = d.kidnapped.includes(t) ? 'Carried away since the last update, without being told.' : WHY[verdict];
  $('now-lost').textContent = percent(d.lost[t]);
  const error = d.truth && Number.isFinite(d.error[t]) ? `${metres(d.error[t])}, ${degrees(d.turn[t])}` : 'no reference here';
  $('now-error').textContent = error;
  $('now-pose').textContent = known(here) ? `${here[0].toFixed(2)}, ${here[1].toFixed(2)} m, ${degrees(here[2])}` : '–';
  $('now-time').textContent = clock(d.stamps[t]);
  const rows = places(d, t), others = rows.slice(4).reduce((sum, row) => sum + row[0], 0);
  $('places').replaceChildren(...rows.slice(0, 4).map(row => {
    const item = document.createElement('li'), text = document.createElement('span'), bar = document.createElement('span');
    text.textContent = `${percent(row[0])} at ${row[1].toFixed(1)}, ${row[2].toFixed(1)} m, ${degrees(row[3])}`;
    bar.className = 'bar-of'; bar.style.setProperty('--w', `${100 * row[0]}%`);
    item.append(text, bar);
    return item;
  }));
  if (rows.length > 4) {
    const item = document.createElement('li');
    item.textContent = `and ${rows.length - 4} more, ${percent(others)}`;
    $('places').append(item);
  }
  $('update').textContent = `Update ${t + 1} of ${count()}`;
  $('slider').value = t;
  $('slider').setAttribute('aria-valuetext', `update ${t + 1} of ${count()}, ${NAMES[verdict]}`);
  $('map').setAttribute('aria-label', `Map. Update ${t + 1}: ${NAMES[verdict]}, pose ${$('now-pose').textContent}, error ${error}, ${rows.length} places`);
  if (!state.playing) $('live').textContent = `Update ${t + 1}: ${NAMES[verdict]}, probability of being lost ${percent(d.lost[t])}, error ${error}`;
};
let asked = false;
const draw = () => {
  if (asked) return;
  asked = true;
  requestAnimationFrame(() => { asked = false; drawMap(); if (drives.length) drawCharts(); });
};
const remember = () => {
  const hash = (drives.length > 1 ? `#d=${state.drive + 1}&` : '#') + `t=${state.t}`;
  try { history.replaceState(null, '', hash); } catch { /* a viewer without history */ }
};
const go = (t, quiet = false) => {
  state.t = Math.min(count() - 1, Math.max(0, Math.round(t)));
  tell(); draw();
  if (!quiet) remember();
};
const choose = number => {
  state.drive = Math.min(drives.length - 1, Math.max(0, number));
  const d = drive();
  $('drive').value = state.drive;
  $('slider').max = count() - 1;
  for (const id of ['has-truth', 'has-error', 'has-error-chart']) $(id).hidden = !d.truth;
  $('next-kidnapping').disabled = !d.kidnapped.length;
  $('next-worst').disabled = !d.moments.some(m => m.kind !== 'kidnapping');
  $('moments').replaceChildren(...d.moments.map(m => {
    const item = document.createElement('li'), button = document.createElement('button');
    const [what, where] = [document.createElement('span'), document.createElement('span')];
    what.textContent = m.kind === 'kidnapping' ? 'Carried away' : m.kind === 'worst' ? `Worst: ${m.says}` : `Sure and wrong: ${m.says}`;
    where.textContent = clock(d.stamps[m.update]);
    button.type = 'button';
    button.append(what, where);
    button.addEventListener('click', () => { stop(); go(m.update); });
    item.append(button);
    return item;
  }));
  if (!d.moments.length) $('moments').textContent = 'Nothing went wrong.';
};

// Playing.
let timer = null;
const stop = () => {
  clearInterval(timer);
  state.playing = false;
  $('play').textContent = 'Play';
  $('play').setAttribute('aria-label', 'Play');
};
const play = () => {
  if (state.t >= count() - 1) go(0);
  state.playing = true;
  $('play').textContent = 'Stop';
  $('play').setAttribute('aria-label', 'Stop');
  clearInterval(timer);
  timer = setInterval(() => {
    if (state.t >= count() - 1) { stop(); remember(); tell(); } else go(state.t + 1, true);
  }, 1000 / Number($('speed').value));
};
const toggle = () => { if (state.playing) { stop(); remember(); tell(); } else play(); };
const next = wanted => {
  const all = drive().moments.filter(wanted).map(m => m.update);
  if (!all.length) return;
  stop();
  go(all.find(t => t > state.t) ?? all[0]);
};
const isKidnapping = m => m.kind === 'kidnapping', isBad = m => m.kind !== 'kidnapping';
const zoom = factor => { state.zoom = Math.min(40, Math.max(0.5, state.zoom * factor)); draw(); };
const fit = () => { Object.assign(state, { zoom: 1, centre: null, follow: false }); $('follow').checked = false; draw(); };
const follow = on => {
  state.follow = on;
  $('follow').checked = on;
  if (on && state.zoom < 1.5) state.zoom = Math.max(1.5, Math.max(x1 - x0, y1 - y0) / 16);
  draw();
};

const wire = () => {
  $('zoom-in').addEventListener('click', () => zoom(1.4));
  $('zoom-out').addEventListener('click', () => zoom(1 / 1.4));
  $('zoom-fit').addEventListener('click', fit);
  const map = $('map');
  map.addEventListener('pointerdown', e => {
    const box = map.getBoundingClientRect();
    state.drag = { x: e.clientX, y: e.clientY, ...viewpoint(box.width, box.height) };
    map.setPointerCapture(e.pointerId);
  });
  map.addEventListener('pointermove', e => {
    if (!state.drag) return;
    const { x, y, scale, centre } = state.drag;
    state.centre = [centre[0] - (e.clientX - x) / scale, centre[1] + (e.clientY - y) / scale];
    if (state.follow) follow(false);
    draw();
  });
  for (const end of ['pointerup', 'pointercancel']) map.addEventListener(end, () => { state.drag = null; });
  map.addEventListener('wheel', e => { if (e.ctrlKey) { e.preventDefault(); zoom(e.deltaY < 0 ? 1.15 : 1 / 1.15); } }, { passive: false });
  window.addEventListener('resize', draw);
  const themed = () => { readColours(); tint(); draw(); };
  window.matchMedia('(prefers-color-scheme: dark)').addEventListener('change', themed);
  const now = () => { readColours(); tint(); drawMap(); if (drives.length) drawCharts(); };
  window.addEventListener('beforeprint', () => { document.documentElement.classList.add('paper'); now(); });
  window.addEventListener('afterprint', () => { document.documentElement.classList.remove('paper'); now(); });
  if (!drives.length) return;
  drives.forEach((d, n) => $('drive').append(new Option(d.name, n)));
  $('pick').hidden = drives.length < 2;
  $('drive').addEventListener('change', e => { stop(); choose(Number(e.target.value)); go(0); });
  $('play').addEventListener('click', toggle);
  $('step').addEventListener('click', () => { stop(); go(state.t + 1); });
  $('back').addEventListener('click', () => { stop(); go(state.t - 1); });
  $('next-kidnapping').addEventListener('click', () => next(isKidnapping));
  $('next-worst').addEventListener('click', () => next(isBad));
  $('follow').addEventListener('change', e => follow(e.target.checked));
  $('speed').addEventListener('change', () => { if (state.playing) play(); });
  $('slider').addEventListener('input', e => { stop(); go(Number(e.target.value)); });
  for (const box of $('layers').querySelectorAll('input')) box.addEventListener('change', draw);
  for (const id of ['chart-lost', 'chart-error']) {
    const canvas = $(id), at = e => {
      const box = canvas.getBoundingClientRect();
      go((e.clientX - box.left - LEFT) / (box.width - LEFT - RIGHT) * (count() - 1));
    };
    canvas.addEventListener('pointerdown', e => { stop(); canvas.setPointerCapture(e.pointerId); at(e); });
    canvas.addEventListener('pointermove', e => { if (e.buttons) at(e); });
  }
  const keys = {
    ' ': toggle, ArrowRight: () => { stop(); go(state.t + 1); }, ArrowLeft: () => { stop(); go(state.t - 1); },
    Home: () => go(0), End: () => go(count() - 1), k: () => next(isKidnapping), w: () => next(isBad),
    f: () => follow(!state.follow), '+': () => zoom(1.4), '-': () => zoom(1 / 1.4), 0: fit,
  };
  player.addEventListener('keydown', e => {
    // Controls keep the keys that are theirs.
    const own = e.target.matches('select, input[type=range]') || (e.target.matches('button, input, summary') && ' Enter'.includes(e.key));
    const action = keys[e.key.length === 1 ? e.key.toLowerCase() : e.key];
    if (own || !action || e.ctrlKey || e.metaKey || e.altKey) return;
    e.preventDefault();
    action();
  });
  window.addEventListener('hashchange', fromAddress);
  $('verdict-legend').replaceChildren(...data.verdicts.map(name => {
    const item = document.createElement('span');
    item.textContent = NAMES[name];
    item.style.setProperty('--tone', `var(--${name})`);
    item.style.setProperty('--h', `${11 * HEIGHT[name]}px`);
    return item;
  }));
};
const fromAddress = () => {
  const asked = new URLSearchParams(location.hash.slice(1));
  choose(asked.has('d') ? Number(asked.get('d')) - 1 || 0 : state.drive);
  const t = Number(asked.get('t'));
  go(Number.isFinite(t) ? t : 0, true);
};

readColours();
wire();
if (drives.length) fromAddress();
else for (const id of ['pick', 'layers', 'moment', 'transport']) $(id).hidden = true;
load('map', data.map);
load('overlay', data.overlay);
draw();
})();
