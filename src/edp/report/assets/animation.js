"use strict";
(() => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const { geometry: g, rate } = scene;
  const frames = scene.angles[0].length;
  const colours = ["#0b57d0", "#b8731a", "#1b6e53"];
  const names = ["Boom", "Arm", "Bucket"];
  const side = edpSideView(g);

  // Colours by their light ones, as in palette.css.
  const named = (colour) => `var(--c${colour.slice(1)}, ${colour})`;
  const paint = (colour) => getComputedStyle(document.documentElement).getPropertyValue(`--c${colour.slice(1)}`).trim() || colour;

  const at = (columns, frame) => {
    const k = Math.min(Math.floor(frame), frames - 2), w = frame - k;
    return columns.map((column) => (column[k] === null || column[k + 1] === null ? NaN : column[k] * (1 - w) + column[k + 1] * w));
  };
  const tips = Array.from({ length: frames }, (_, k) => side.pose(scene.angles.map((x) => x[k])).tip);
  const soil = scene.ground.length > 0 && scene.ground[0].length > 0;

  const front = document.getElementById("front");

  function drawFront(frame) {
    const last = Math.floor(frame), load = scene.readings["payload kg"];
    side.draw(front, {
      angles: at(scene.angles, frame),
      path: document.getElementById("path").checked ? tips.slice(Math.max(0, last - Math.round(12 * rate)), last + 1) : [],
      heights: soil ? scene.ground[Math.min(Math.floor(frame / scene.ground_every), scene.ground.length - 1)] : null,
      heightsX: scene.ground_x,
      loaded: Boolean(load) && load[last] > 30,
    });
  }

  const WINDOW = 12;
  const charts = [];
  const holder = document.getElementById("charts");
  function chart(title, unit, rows, exact = false) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const canvas = document.createElement("canvas");
    const head = document.createElement("b");
    head.textContent = `${title} [${unit}]`;
    caption.append(head);
    const values = rows.map((row) => {
      const entry = document.createElement("span"), key = document.createElement("i"), value = document.createElement("span");
      key.style.borderColor = named(row.colour);
      if (row.dashed) key.className = "dashed";
      entry.append(key, `${row.name} `, value);
      caption.append(entry);
      return value;
    });
    figure.append(caption, canvas);
    holder.append(figure);
    let low = Infinity, high = -Infinity;
    const reach = (v) => { if (v !== null) { low = Math.min(low, v); high = Math.max(high, v); } };
    rows.forEach((row) => [row.data, ...(row.band || [])].forEach((column) => column.forEach(reach)));
    if (low > high) { low = 0; high = 1; }
    const room = 0.06 * (high - low || 1);
    canvas.addEventListener("click", (event) => {
      const [first, last] = span(position), plot = canvas.clientWidth - 46;
      seek(first + ((event.offsetX - 40) / plot) * (last - first));
    });
    charts.push({ canvas, rows, values, exact, low: low - room, high: high + room });
  }
  const span = (frame) => {
    const width = Math.min(WINDOW * rate, frames - 1);
    const first = Math.max(0, Math.min(frame - 0.7 * width, frames - 1 - width));
    return [first, first + width];
  };
  const nice = (low, high) => {
    const raw = (high - low) / 5, power = 10 ** Math.floor(Math.log10(raw));
    return [1, 2, 2.5, 5, 10].map((m) => m * power).find((step) => step >= raw);
  };

  function drawChart(it, frame, height) {
    const [c, width] = edpCanvas(it.canvas, height);
    const [first, last] = span(frame);
    const left = 40, right = width - 6, top = 6, bottom = height - 18;
    const px = (k) => left + ((k - first) / (last - first)) * (right - left);
    const py = (v) => bottom - ((v - it.low) / (it.high - it.low)) * (bottom - top);
    c.font = "11.5px sans-serif"; c.fillStyle = paint("#66717d"); c.strokeStyle = paint("#e4e8ec"); c.lineWidth = 1;
    const step = nice(it.low, it.high);
    c.textAlign = "right";
    for (let v = Math.ceil(it.low / step) * step; v <= it.high; v += step) {
      const y = py(v);
      c.beginPath(); c.moveTo(left, y); c.lineTo(right, y); c.stroke();
      c.fillText(String(Math.round(v * 1e6) / 1e6), left - 5, y + 4);
    }
    c.textAlign = "center";
    const every = Math.max(1, Math.round((last - first) / rate / 6));
    for (let s = Math.ceil(first / rate / every) * every; s <= last / rate; s += every) {
      const x = px(s * rate);
      if (x > left + 8 && x < right - 8) c.fillText(`${Math.round((s + scene.start) * 10) / 10} s`, x, height - 4);
    }
    c.save(); c.beginPath(); c.rect(left, 0, right - left, bottom + 1); c.clip();
    const begin = Math.max(0, Math.floor(first)), end = Math.min(frames - 1, Math.ceil(last));
    it.rows.forEach((row) => {
      if (row.band) {
        const [lower, upper] = row.band;
        c.fillStyle = paint(row.colour); c.globalAlpha = 0.16;
        for (let k = begin; k < end; k++) {
          if ([lower[k], upper[k], lower[k + 1], upper[k + 1]].includes(null)) continue;
          c.beginPath(); c.moveTo(px(k), py(lower[k])); c.lineTo(px(k + 1), py(lower[k + 1]));
          c.lineTo(px(k + 1), py(upper[k + 1])); c.lineTo(px(k), py(upper[k])); c.fill();
        }
        c.globalAlpha = 1;
      }
      c.strokeStyle = paint(row.colour); c.lineWidth = row.dashed ? 1.4 : 1.8; c.setLineDash(row.dashed ? [4, 3] : []);
      c.beginPath();
      let drawing = false;
      for (let k = begin; k <= end; k++) {
        if (row.data[k] === null) { drawing = false; continue; }
        if (drawing) c.lineTo(px(k), py(row.data[k])); else c.moveTo(px(k), py(row.data[k]));
        drawing = true;
      }
      c.stroke();
    });
    c.setLineDash([]); c.restore();
    c.strokeStyle = paint("#b3261e"); c.lineWidth = 1;
    c.beginPath(); c.moveTo(px(frame), top); c.lineTo(px(frame), bottom); c.stroke();
    const places = Math.max(0, Math.min(6, 2 - Math.floor(Math.log10(it.high - it.low))));
    it.rows.forEach((row, i) => {
      const value = at([row.data], frame)[0];
      it.values[i].textContent = Number.isNaN(value) ? "none" : value.toFixed(it.exact ? places : 0).replace(/^-(0(?:\.0+)?)$/, "$1");
    });
  }

  let position = 0, playing = true, before = null;
  const scrub = document.getElementById("scrub"), clock = document.getElementById("clock"), play = document.getElementById("play");
  const readings = document.getElementById("readings");
  scrub.max = frames - 1;
  const shown = Object.keys(scene.readings).map((name) => {
    const box = document.createElement("div"), term = document.createElement("dt"), value = document.createElement("dd");
    term.textContent = name; box.append(term, value); readings.append(box);
    return [name, value];
  });
  scene.forecasts.forEach((line) => chart(line.name, line.unit, [
    { name: "measured", data: line.measured, colour: "#3c4650" },
    { name: "predicted", data: line.predicted, colour: "#0b57d0", dashed: true, band: line.lower && [line.lower, line.upper] },
  ], true));
  chart("Cylinder velocity", "mm/s", scene.velocity.map((data, i) => ({ name: names[i], data, colour: colours[i] })));
  for (let i = 0; i < scene.pressure.length / 2; i++) {
    chart(`${names[i]} pressure`, "bar", [
      { name: "head", data: scene.pressure[2 * i], colour: colours[i] },
      { name: "rod", data: scene.pressure[2 * i + 1], colour: colours[i], dashed: true },
    ]);
  }

  function draw() {
    drawFront(position);
    const tall = Math.max(96, Math.min(170, (front.clientHeight + 60) / charts.length - 34));
    charts.forEach((it) => drawChart(it, position, tall));
    scrub.value = Math.round(position);
    clock.textContent = `${(scene.start + position / rate).toFixed(1)} of ${(scene.start + (frames - 1) / rate).toFixed(1)} s`;
    shown.forEach(([name, value]) => { value.textContent = at([scene.readings[name]], position)[0].toFixed(name.startsWith("payload") ? 0 : 1); });
  }
  function seek(frame) { position = Math.max(0, Math.min(frames - 1, frame)); draw(); }
  function setPlaying(on) { playing = on; before = null; play.textContent = on ? "Pause" : "Play"; }
  play.addEventListener("click", () => { if (!playing && position >= frames - 1) position = 0; setPlaying(!playing); });
  scrub.addEventListener("input", () => seek(Number(scrub.value)));
  document.getElementById("path").addEventListener("change", draw);
  document.addEventListener("keydown", (event) => {
    if (event.target.matches("input, select, button")) return;
    if (event.key === " ") { event.preventDefault(); play.click(); }
    if (event.key === "ArrowRight" || event.key === "ArrowLeft") seek(position + (event.key === "ArrowRight" ? 1 : -1) * rate);
  });
  window.addEventListener("resize", draw);
  window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  const wanted = /^#t=([\d.]+)$/.exec(window.location.hash);
  if (wanted) { setPlaying(false); position = Math.max(0, Math.min(frames - 1, (Number(wanted[1]) - scene.start) * rate)); }
  draw();
  function tick(now) {
    if (playing) {
      if (before !== null) {
        position += ((now - before) / 1000) * rate * Number(document.getElementById("speed").value);
        if (position >= frames - 1) { position = frames - 1; setPlaying(false); }
        draw();
      }
      before = playing ? now : null;
    }
    window.requestAnimationFrame(tick);
  }
  window.requestAnimationFrame(tick);
})();
