"use strict";
/* A canvas with a height (CSS pixels), cleared: its context, width and height. */
function edpCanvas(canvas, height) {
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

/* The machine's front from the side: animations, reports of loops and the live view draw it by these functions.
   `g` is the geometry that edp.report.animation.page.geometry_of writes. */
function edpSideView(g) {
  const rad = Math.PI / 180;
  const LIGHT = {
    cylinders: ["#0b57d0", "#b8731a", "#1b6e53"], soil: "#efe8dd", surface: "#9a7f5c", level: "#c9d0d6", tick: "#e7ebee",
    text: "#76828d", track: "#59636d", trackEdge: "#3d464e", deck: "#d9dee3", cab: "#f3f6f8", edge: "#9aa4ad",
    rod: "#8a949e", steel: "#f0c75e", steelEdge: "#8c6a12", link: "#4d5862", bucket: "#c7ced4", loaded: "#b59a74",
    teeth: "#1c252e", pin: "#2a333c", tip: "#b3261e", path: "179, 38, 30",
  };
  const DARK = {
    soil: "#3a3128", surface: "#9a7f5c", level: "#4a5560", tick: "#333c45", text: "#a3aeb8", deck: "#5b6671", cab: "#7d8893",
    track: "#3d464e", trackEdge: "#59636d", pin: "#e8ecf0", link: "#b6c0c9", bucket: "#8a949e", teeth: "#e8ecf0", path: "242, 147, 140", tip: "#f2938c",
    steel: "#d9ae45", cylinders: ["#8ab4f8", "#e0a458", "#74c7a5"],
  };
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
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
  const reach = L1 + L2 + L3;
  const view = { left: -0.47 * reach, right: 1.06 * reach, bottom: -g.foot - 0.66 * reach, top: 0.86 * reach };

  /* Draw `shown`: angles (rad), and where there are any path (points before and above the boom foot, m), heights of the
     ground at heightsX, whether the bucket is loaded. */
  function draw(canvas, shown) {
    const paint = { ...LIGHT, ...(dark.matches ? DARK : {}) };
    const wide = canvas.clientWidth;
    const scale = wide / (view.right - view.left);
    const [c, width, height] = edpCanvas(canvas, Math.round((view.top - view.bottom) * scale));
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
    if (shown.heights) {
      const heights = shown.heights;
      const line = shown.heightsX.map((x, k) => [x, heights[k]]);
      shape([[view.left, level], [0, level], ...line, [view.right, heights[heights.length - 1]],
        [view.right, view.bottom], [view.left, view.bottom]], paint.soil);
      shape([[view.left, level], ...line, [view.right, heights[heights.length - 1]]], null, paint.surface, 1.6);
    } else {
      shape([[view.left, level], [view.right, level]], null, paint.level, 1);
    }
    c.strokeStyle = paint.tick; c.fillStyle = paint.text; c.font = "12px sans-serif"; c.textAlign = "center";
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
    shape(track, paint.track, paint.trackEdge);
    const deck = bottom + 1.05 * u;
    shape([[-3.6 * u, deck], [0.55 * u, deck], [0.55 * u, deck + 0.5 * u], [-1.2 * u, deck + 1.1 * u],
      [-3.6 * u, deck + 1.15 * u]], paint.deck, paint.edge);
    shape([[-1.15 * u, deck + 0.5 * u], [0.25 * u, deck + 0.5 * u], [0.1 * u, deck + 2.1 * u], [-1.15 * u, deck + 2.2 * u]],
      paint.cab, paint.edge);

    const p = pose(shown.angles);
    const path = shown.path || [], last = path.length - 1;
    c.lineWidth = 1.6;
    for (let k = 0; k < last; k += 2) {
      c.strokeStyle = `rgba(${paint.path}, ${(0.08 + 0.75 * k / (last + 1)).toFixed(3)})`;
      c.beginPath(); c.moveTo(...X(path[k])); c.lineTo(...X(path[Math.min(k + 2, last)])); c.stroke();
    }
    const cylinder = (from, to, thick, colour) => {
      const length = Math.hypot(to[0] - from[0], to[1] - from[1]);
      const mid = [from[0] + (to[0] - from[0]) * 0.55, from[1] + (to[1] - from[1]) * 0.55];
      shape([from, to], null, paint.rod, Math.max(2, thick * 0.5 * scale));
      shape([from, length ? mid : to], null, colour, Math.max(3, thick * scale));
    };
    const inBoom = (x, y) => turn([x, y], p.a), inArm = (x, y) => put(p.arm, p.b, [x, y]);
    const inBucket = (x, y) => put(p.bucket, p.c, [x, y]);
    cylinder(boomBase, p.boomRod, 0.14 * u, paint.cylinders[0]);
    shape([inBoom(-0.1 * u, 0.03 * L1), p.boomRod, p.armBase, inBoom(L1, 0.022 * L1), inBoom(L1, -0.022 * L1),
      inBoom(0.6 * L1, 0.085 * L1), inBoom(0.42 * L1, 0.095 * L1), inBoom(0.02 * L1, -0.03 * L1)],
      paint.steel, paint.steelEdge);
    cylinder(p.armBase, p.armRod, 0.13 * u, paint.cylinders[1]);
    shape([p.armRod, inArm(0.1 * L2, 0.12 * L2), inArm(0.5 * L2, 0.075 * L2), inArm(L2, 0.02 * L2),
      inArm(L2, -0.03 * L2), inArm(0.1 * L2, -0.055 * L2)], paint.steel, paint.steelEdge);
    cylinder(p.cylinder, p.elbow, 0.12 * u, paint.cylinders[2]);
    shape([p.pivot, p.elbow], null, paint.link, 0.07 * u * scale);
    shape([p.elbow, p.lug], null, paint.link, 0.09 * u * scale);
    const floor = polar(g.bucket.floor_length, Math.PI - g.bucket.floor_angle_deg * rad);
    const heel = [L3 + floor[0], floor[1]], lug = polar(link.lug, link.lug_angle);
    shape([inBucket(0, -0.06 * L3), inBucket(L3, 0), inBucket(...heel), inBucket(heel[0] * 0.5 + lug[0] * 0.5 - 0.02 * L3,
      heel[1] * 0.5 + lug[1] * 0.5 + 0.12 * L3), inBucket(...lug)], shown.loaded ? paint.loaded : paint.bucket, paint.link, 1.4);
    shape([inBucket(L3 * 0.93, 0.05 * L3), inBucket(L3 * 1.0, 0)], null, paint.teeth, 3);
    [[0, 0], p.arm, p.bucket, boomBase, p.boomRod, p.armBase, p.armRod, p.elbow, p.lug].forEach((q) => dot(q, Math.max(2, 0.06 * u * scale), paint.pin));
    dot(p.tip, 3.4, paint.tip);
  }

  return { pose, draw, reach, view };
}
