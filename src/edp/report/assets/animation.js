"use strict";
(() => {
  const scene = JSON.parse(document.getElementById("scene").textContent);
  const { geometry: g, rate } = scene;
  const frames = scene.angles[0].length;
  const rad = Math.PI / 180;
  const colours = ["#0b57d0", "#b8731a", "#1b6e53"];
  const names = ["Boom", "Arm", "Bucket"];
  const polar = (r, a) => [r * Math.cos(a), r * Math.sin(a)];
  const add = (p, q) => [p[0] + q[0], p[1] + q[1]];
  const turn = (p, a) => [p[0] * Math.cos(a) - p[1] * Math.sin(a), p[0] * Math.sin(a) + p[1] * Math.cos(a)];
  const put = (origin, angle, p) => add(origin, turn(p, angle));

  // The file gives only the difference of the two pin angles; the frame's (-43 deg) and the boom's (155 deg) are usual.
  const boomBase = polar(g.boom.base_radius, -43 * rad);
  const boomRod = polar(g.boom.rod_radius, (g.boom.offset_deg - 43) * rad);
  const armBase = polar(g.arm.base_radius, 155 * rad);
  const armRod = polar(g.arm.rod_radius, (155 - g.arm.offset_deg) * rad);
  const link = g.linkage;
  const [L1, L2, L3] = g.length;
  const pivot = [L2 - link.pivot_to_pin, link.pivot_offset];

  /* Where every joint and pin is at three angles (rad), in metres before and above the boom foot. */
  function pose(angles) {
    const [a, b, c] = [angles[0], angles[0] + angles[1], angles[0] + angles[1] + angles[2]];
    const arm = polar(L1, a);
    const bucket = put(arm, b, [L2, 0]);
    const lugInArm = add([L2, 0], polar(link.lug, angles[2] + link.lug_angle));
    const d = [lugInArm[0] - pivot[0], lugInArm[1] - pivot[1]];
    const d2 = d[0] * d[0] + d[1] * d[1];
    const along = 0.5 * (1 + (link.rocker ** 2 - link.link ** 2) / d2);
    const across = Math.sqrt(Math.max(link.rocker ** 2 / d2 - along * along, 0));
    const elbow = [pivot[0] + along * d[0] - across * d[1], pivot[1] + along * d[1] + across * d[0]];
    return {
      a, b, c, arm, bucket, tip: put(bucket, c, [L3, 0]), lug: put(arm, b, lugInArm), elbow: put(arm, b, elbow),
      pivot: put(arm, b, pivot), cylinder: put(arm, b, link.cylinder_pin),
      boomRod: turn(boomRod, a), armBase: put(arm, a, armBase), armRod: put(arm, b, armRod),
    };
  }

  const at = (columns, frame) => {
    const k = Math.min(Math.floor(frame), frames - 2), w = frame - k;
    return columns.map((column) => column[k] * (1 - w) + column[k + 1] * w);
  };
  const tips = Array.from({ length: frames }, (_, k) => pose(scene.angles.map((x) => x[k])).tip);
  const reach = L1 + L2 + L3;
  const soil = scene.ground.length > 0 && scene.ground[0].length > 0;

  function fit(canvas, height) {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth;
    canvas.style.height = `${height}px`;
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
    const c = canvas.getContext("2d");
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.clearRect(0, 0, width, height);
    return [c, width, height];
  }

  const view = { left: -0.47 * reach, right: 1.06 * reach, bottom: -g.foot - 0.66 * reach, top: 0.86 * reach };
  const front = document.getElementById("front");

  function drawFront(frame) {
    const wide = front.clientWidth;
    const scale = wide / (view.right - view.left);
    const [c, width, height] = fit(front, Math.round((view.top - view.bottom) * scale));
    const X = (p) => [(p[0] - view.left) * scale, (view.top - p[1]) * scale];
    const shape = (points, fill, stroke, line = 1) => {
      c.beginPath();
      points.forEach((p, i) => (i ? c.lineTo(...X(p)) : c.moveTo(...X(p))));
      if (fill) { c.closePath(); c.fillStyle = fill; c.fill(); }
      if (stroke) { c.strokeStyle = stroke; c.lineWidth = line; c.stroke(); }
    };
    const dot = (p, r, fill) => { c.beginPath(); c.arc(...X(p), r, 0, 7); c.fillStyle = fill; c.fill(); };
    const unit = reach / 10;
    c.lineJoin = c.lineCap = "round";

    const level = -g.foot;
    if (soil) {
      const heights = scene.ground[Math.min(Math.floor(frame / scene.ground_every), scene.ground.length - 1)];
      const line = scene.ground_x.map((x, k) => [x, heights[k]]);
      shape([[view.left, level], [0, level], ...line, [view.right, heights[heights.length - 1]],
        [view.right, view.bottom], [view.left, view.bottom]], "#efe8dd");
      shape([[view.left, level], ...line, [view.right, heights[heights.length - 1]]], null, "#9a7f5c", 1.6);
    } else {
      shape([[view.left, level], [view.right, level]], null, "#c9d0d6", 1);
    }
    c.strokeStyle = "#e7ebee"; c.fillStyle = "#76828d"; c.font = "12px sans-serif"; c.textAlign = "center";
    for (let x = Math.ceil(view.left / 2) * 2; x < view.right; x += 2) {
      const [px] = X([x, 0]);
      c.fillRect(px, height - 6, 1, 6);
      if (px > 20 && px < width - 20) c.fillText(`${x} m`, px, height - 10);
    }
    c.textAlign = "left";
    for (let y = Math.ceil(view.bottom / 2) * 2; y < view.top; y += 2) {
      const [, py] = X([0, y + level]);
      c.fillRect(0, py, 6, 1);
      if (py > 12 && py < height - 26) c.fillText(`${y} m`, 9, py + 4);
    }

    // undercarriage, house and cab: a sketch, not data
    const u = unit, bottom = level;
    const track = [[-2.9 * u, bottom], [1.1 * u, bottom], [1.45 * u, bottom + 0.45 * u], [1.1 * u, bottom + 0.9 * u],
      [-2.9 * u, bottom + 0.9 * u], [-3.25 * u, bottom + 0.45 * u]];
    shape(track, "#59636d", "#3d464e");
    const deck = bottom + 1.05 * u;
    shape([[-3.6 * u, deck], [0.55 * u, deck], [0.55 * u, deck + 0.5 * u], [-1.2 * u, deck + 1.1 * u],
      [-3.6 * u, deck + 1.15 * u]], "#d9dee3", "#9aa4ad");
    shape([[-1.15 * u, deck + 0.5 * u], [0.25 * u, deck + 0.5 * u], [0.1 * u, deck + 2.1 * u], [-1.15 * u, deck + 2.2 * u]],
      "#f3f6f8", "#9aa4ad");

    const p = pose(at(scene.angles, frame));
    if (document.getElementById("path").checked) {
      const last = Math.floor(frame), first = Math.max(0, last - Math.round(12 * rate));
      c.lineWidth = 1.6;
      for (let k = first; k < last; k += 2) {
        c.strokeStyle = `rgba(179, 38, 30, ${(0.08 + 0.75 * (k - first) / (last - first + 1)).toFixed(3)})`;
        c.beginPath(); c.moveTo(...X(tips[k])); c.lineTo(...X(tips[Math.min(k + 2, last)])); c.stroke();
      }
    }
    const cylinder = (from, to, thick, colour) => {
      const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
      const mid = [from[0] + (to[0] - from[0]) * 0.55, from[1] + (to[1] - from[1]) * 0.55];
      shape([from, to], null, "#8a949e", Math.max(2, thick * 0.5 * scale));
      shape([from, length ? mid : to], null, colour, Math.max(3, thick * scale));
    };
    const inBoom = (x, y) => turn([x, y], p.a), inArm = (x, y) => put(p.arm, p.b, [x, y]);
    const inBucket = (x, y) => put(p.bucket, p.c, [x, y]);
    cylinder(boomBase, p.boomRod, 0.14 * u, colours[0]);
    shape([inBoom(-0.1 * u, 0.03 * L1), p.boomRod, p.armBase, inBoom(L1, 0.022 * L1), inBoom(L1, -0.022 * L1),
      inBoom(0.6 * L1, 0.085 * L1), inBoom(0.42 * L1, 0.095 * L1), inBoom(0.02 * L1, -0.03 * L1)],
      "#f0c75e", "#8c6a12");
    cylinder(p.armBase, p.armRod, 0.13 * u, colours[1]);
    shape([p.armRod, inArm(0.1 * L2, 0.12 * L2), inArm(0.5 * L2, 0.075 * L2), inArm(L2, 0.02 * L2),
      inArm(L2, -0.03 * L2), inArm(0.1 * L2, -0.055 * L2)], "#f0c75e", "#8c6a12");
    cylinder(p.cylinder, p.elbow, 0.12 * u, colours[2]);
    shape([p.pivot, p.elbow], null, "#4d5862", 0.07 * u * scale);
    shape([p.elbow, p.lug], null, "#4d5862", 0.09 * u * scale);
    const floor = polar(g.bucket.floor_length, Math.PI - g.bucket.floor_angle_deg * rad);
    const heel = [L3 + floor[0], floor[1]], lug = polar(link.lug, link.lug_angle);
    const load = scene.readings["payload kg"];
    shape([inBucket(0, -0.06 * L3), inBucket(L3, 0), inBucket(...heel), inBucket(heel[0] * 0.5 + lug[0] * 0.5 - 0.02 * L3,
      heel[1] * 0.5 + lug[1] * 0.5 + 0.12 * L3), inBucket(...lug)], load && load[Math.floor(frame)] > 30 ? "#b59a74" : "#c7ced4", "#4d5862", 1.4);
    shape([inBucket(L3 * 0.93, 0.05 * L3), inBucket(L3 * 1.0, 0)], null, "#1c252e", 3);
    [[0, 0], p.arm, p.bucket, boomBase, p.boomRod, p.armBase, p.armRod, p.elbow, p.lug].forEach((q) => dot(q, Math.max(2, 0.06 * u * scale), "#2a333c"));
    dot(p.tip, 3.4, "#b3261e");
  }

  const WINDOW = 12;
  const charts = [];
  const holder = document.getElementById("charts");
  function chart(title, unit, rows) {
    const figure = document.createElement("figure"), caption = document.createElement("figcaption");
    const canvas = document.createElement("canvas");
    const head = document.createElement("b");
    head.textContent = `${title} [${unit}]`;
    caption.append(head);
    const values = rows.map((row) => {
      const entry = document.createElement("span"), key = document.createElement("i"), value = document.createElement("span");
      key.style.borderColor = row.colour;
      if (row.dashed) key.className = "dashed";
      entry.append(key, `${row.name} `, value);
      caption.append(entry);
      return value;
    });
    figure.append(caption, canvas);
    holder.append(figure);
    let low = Infinity, high = -Infinity;
    rows.forEach((row) => row.data.forEach((v) => { low = Math.min(low, v); high = Math.max(high, v); }));
    const room = 0.06 * (high - low || 1);
    canvas.addEventListener("click", (event) => {
      const [first, last] = span(position), plot = canvas.clientWidth - 46;
      seek(first + ((event.offsetX - 40) / plot) * (last - first));
    });
    charts.push({ canvas, rows, values, low: low - room, high: high + room });
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
    const [c, width] = fit(it.canvas, height);
    const [first, last] = span(frame);
    const left = 40, right = width - 6, top = 6, bottom = height - 18;
    const px = (k) => left + ((k - first) / (last - first)) * (right - left);
    const py = (v) => bottom - ((v - it.low) / (it.high - it.low)) * (bottom - top);
    c.font = "11.5px sans-serif"; c.fillStyle = "#66717d"; c.strokeStyle = "#e4e8ec"; c.lineWidth = 1;
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
    it.rows.forEach((row) => {
      c.strokeStyle = row.colour; c.lineWidth = row.dashed ? 1.4 : 1.8; c.setLineDash(row.dashed ? [4, 3] : []);
      c.beginPath();
      for (let k = Math.max(0, Math.floor(first)); k <= Math.min(frames - 1, Math.ceil(last)); k++) c.lineTo(px(k), py(row.data[k]));
      c.stroke();
    });
    c.setLineDash([]); c.restore();
    c.strokeStyle = "#b3261e"; c.lineWidth = 1;
    c.beginPath(); c.moveTo(px(frame), top); c.lineTo(px(frame), bottom); c.stroke();
    it.rows.forEach((row, i) => { it.values[i].textContent = at([row.data], frame)[0].toFixed(0); });
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
