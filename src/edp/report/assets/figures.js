"use strict";
// One figure: its panels, legend, values under the pointer, and zoom. On a narrow screen panels stand below each other.
const Figure = (function () {
  const { Axis, number, plain, values } = FigureAxes;
  const { bars, cells, element, scaleBar, scatter, shape, symbols, themed, words, DASHES } = FigureMarks;
  const NARROW = 620;
  const [INK, SOFT, RULE] = ["#26303a", "#5b6671", "#e4e8ec"];
  const ruler = document.createElement("canvas").getContext("2d");
  let numbered = 0;

  function width(text, size) {
    ruler.font = `${size || 12}px ${getComputedStyle(document.body).fontFamily}`;
    return ruler.measureText(text).width;
  }

  // As much of a text as fits, without its middle: names of one figure often begin alike, or end alike.
  function fitting(text, room, size) {
    if (width(text, size) <= room) return text;
    const cut = text.indexOf("\u2026"), middle = Math.ceil(text.length / 2);
    let [begin, end] = cut < 0 ? [text.slice(0, middle), text.slice(middle)] : [text.slice(0, cut), text.slice(cut + 1)];
    while (begin.length + end.length > 4 && width(`${begin}\u2026${end}`, size) > room) {
      if (begin.length > end.length) begin = begin.slice(0, -1);
      else end = end.slice(1);
    }
    return `${begin}\u2026${end}`;
  }

  // Texts of one axis: where the middle was what told them apart, what they begin with is left out instead.
  function fittingAll(texts, room, size) {
    const cut = texts.map((text) => fitting(text, room, size));
    if (new Set(cut).size === new Set(texts).size) return cut;
    const shared = texts.filter((text, i) => cut.some((other, k) => other === cut[i] && texts[k] !== text));
    let same = 0;
    while (shared.every((text) => text.length > same + 1 && text[same] === shared[0][same])) same += 1;
    return texts.map((text, i) => (shared.includes(text) ? fitting("\u2026" + text.slice(Math.max(same - 2, 1)), room, size) : cut[i]));
  }

  function html(parent, name, attributes, text) {
    const made = document.createElement(name);
    Object.entries(attributes || {}).forEach(([key, value]) => made.setAttribute(key, value));
    if (text !== undefined) made.textContent = text;
    parent.appendChild(made);
    return made;
  }

  class Figure {
    // box: its place on the page. spec: name and figure. label: what a reader who does not see it is told.
    constructor(box, spec, label) {
      this.box = box;
      this.layout = spec.figure.layout;
      this.data = spec.figure.data.map((trace) => {
        const read = { ...trace };
        ["x", "y", "z", "customdata"].forEach((key) => { if (trace[key]) read[key] = values(trace[key]); });
        return read;
      });
      this.hidden = new Set();
      this.zoom = {};
      this.label = label;
      this.legend = html(box, "ul", { class: "figure-legend" });
      this.stage = html(box, "div", { class: "figure-stage" });
      this.tip = html(box, "div", { class: "figure-tip", hidden: "" });
      this.back = html(box, "button", { class: "figure-back", type: "button", hidden: "" }, "Whole figure");
      this.back.addEventListener("click", () => this.zoomed({}));
      this.width = 0;
      new ResizeObserver(() => { if (Math.abs(box.clientWidth - this.width) > 1) this.draw(); }).observe(box);
      this.listen();
      this.draw();
    }

    // Show the traces that belong to what is chosen.
    choose(want, keepsZoom) {
      this.data.forEach((trace) => {
        trace.visible = Object.entries(trace.meta || {}).every(([key, value]) => !(key in want) || want[key] === value);
      });
      if (!keepsZoom) this.zoom = {};
      this.draw();
    }

    zoomed(zoom) {
      this.zoom = zoom;
      this.draw();
    }

    shown() {
      return this.data.filter((trace) => trace.visible !== false && !this.hidden.has(trace.legendgroup || trace.name));
    }

    axes() {
      const made = {};
      Object.keys(this.layout).forEach((key) => {
        const match = /^([xy])axis(\d*)$/.exec(key);
        if (match) {
          made[match[1] + match[2]] = new Axis(match[1] + match[2], this.layout[key]);
          made[match[1] + match[2]].short = match[1] + match[2];
        }
      });
      return made;
    }

    // Axes that share their limits have one leader.
    leader(axes, name) {
      const next = axes[name].options.matches;
      return next && next !== name && axes[next] ? this.leader(axes, next) : name;
    }

    panels(axes) {
      return Object.values(axes).filter((axis) => !axis.upright).map((x) => {
        const y = axes[x.options.anchor || "y"];
        const second = Object.values(axes).find((axis) => axis.options.overlaying === y.short);
        const traces = this.shown().filter((t) => (t.xaxis || "x") === x.short && [y.short, second?.short].includes(t.yaxis || "y"));
        return { x, y, second, traces };
      });
    }

    settle(axes) {
      const lead = (name) => axes[this.leader(axes, name)];
      this.shown().forEach((trace) => {
        const [x, y] = [lead(trace.xaxis || "x"), lead(trace.yaxis || "y")];
        if (trace.type === "heatmap") return [[x, trace.x], [y, trace.y]].forEach(([axis, at]) => this.covers(axis, at));
        const across = trace.x && trace.x.length ? trace.x : [trace.x0, trace.x0 + (trace.y.length - 1) * trace.dx];
        if (trace.type === "bar") {
          const [along, reach, far, at] = trace.orientation === "h" ? [y, x, trace.x, trace.y] : [x, y, trace.y, across];
          reach.barred = !reach.log;
          this.covers(along, at);
          const error = trace.error_x || trace.error_y;
          far.forEach((v, i) => { reach.include(v); if (error && v !== null && error.array[i] !== null) [v - error.arrayminus[i], v + error.array[i]].forEach((e) => reach.include(e)); });
          return;
        }
        across.forEach((v) => x.include(v));
        trace.y.forEach((v) => y.include(v));
        if (trace.error_x) trace.x.forEach((v, i) => { if (trace.error_x.array[i] !== null) [v - trace.error_x.arrayminus[i], v + trace.error_x.array[i]].forEach((e) => x.include(e)); });
        if (trace.fill === "tozeroy") y.include(0);
        if ((trace.mode || "lines") !== "lines") x.padded = true;
      });
      const leaders = new Set(Object.keys(axes).map((name) => lead(name)));
      leaders.forEach((axis) => axis.settle(this.zoom[axis.short]));
      Object.keys(axes).forEach((name) => {
        const [axis, first] = [axes[name], lead(name)];
        if (axis !== first) Object.assign(axis, { low: first.low, high: first.high, reversed: first.reversed, categories: first.categories, barred: first.barred });
      });
    }

    // Bars and cells reach half a place beyond their middles.
    covers(axis, at) {
      at.forEach((v) => axis.include(v));
      if (axis.categories) return;
      const sorted = at.map((v) => axis.place(v)).filter(Number.isFinite).sort((a, b) => a - b);
      const half = sorted.length > 1 ? (sorted[1] - sorted[0]) / 2 : 0.5;
      [axis.low, axis.high] = [Math.min(axis.low, sorted[0] - half), Math.max(axis.high, sorted[sorted.length - 1] + half)];
      axis.exact = true;
    }

    // Rows and columns of the panels, by their shares of the figure.
    grid(panels, wide, narrow) {
      const starts = (name) => [...new Set(panels.map((p) => p[name].options.domain[0].toFixed(4)))].sort((a, b) => (name === "x" ? a - b : b - a));
      const [columns, rows] = [starts("x"), starts("y")];
      panels.forEach((panel) => {
        panel.column = columns.indexOf(panel.x.options.domain[0].toFixed(4));
        panel.row = rows.indexOf(panel.y.options.domain[0].toFixed(4));
        panel.share = [panel.x, panel.y].map((axis) => axis.options.domain[1] - axis.options.domain[0]);
      });
      // Panels that share their rows, such as names and what is said of them, stay beside each other.
      const stacked = narrow && columns.length > 1 && (columns.length > 3 || !panels.some((panel) => panel.y.options.matches));
      if (stacked) {
        panels.sort((a, b) => a.row - b.row || a.column - b.column).forEach((panel, i) => Object.assign(panel, { column: 0, row: i, share: [1, 1] }));
      }
      return { columns: stacked ? 1 : columns.length, rows: stacked ? panels.length : rows.length, stacked, times: stacked ? panels.length / rows.length : 1, wide };
    }

    place(panels, grid) {
      const room = grid.wide * (grid.columns > 1 ? 0.22 : 0.42);
      const barred = this.shown().some((t) => t.type === "heatmap" && t.showscale !== false);
      panels.forEach((panel) => {
        const { x, y, second } = panel;
        // A higher panel has finer ticks, whose numbers are longer; its height is not known yet.
        const texts = (axis) => [120, 200, 300, 450].flatMap((high) => axis.ticks(high).map((row) => row[1]));
        const labelled = (axis) => axis && axis.options.visible !== false && (axis.options.showticklabels !== false || grid.stacked);
        panel.labels = { x: labelled(x), y: labelled(y) };
        const longest = labelled(y) ? Math.min(Math.max(0, ...texts(y).map((t) => width(t))), room) : 0;
        panel.pad = {
          left: longest + 10 + (y.options.title.text ? 20 : 0),
          right: second ? Math.max(0, ...texts(second).map((t) => width(t))) + 10 + (second.options.title.text ? 20 : 0) : 12,
          top: (panel.title ? 26 : 10) + (grid.stacked && panel.row ? 12 : 0),
          bottom: (labelled(x) ? 24 + this.slant(x) : 8) + (x.options.title.text ? 20 : 0),
        };
        // The bar of colours stands right of everything, so that panels of one scale keep one size.
        if (panel.column === grid.columns - 1 && barred) panel.pad.right = 66;
        const beyond = panel.traces.filter((t) => t.mode && t.mode.includes("text"));
        if (beyond.length) panel.pad.right = Math.min(Math.max(panel.pad.right, ...beyond.flatMap((t) => t.text.map((w) => width(plain(w)))).map((w) => 0.55 * w + 12)), grid.wide * 0.25);
        if (panel.traces.some((t) => t.texttemplate && t.orientation === "h")) panel.pad.right = Math.max(panel.pad.right, 52);
      });
      const high = this.layout.height * grid.times - 20;
      const tracks = (count, key, index, before, after, total) => {
        const of = Array.from({ length: count }, (_, i) => panels.filter((p) => p[key] === i));
        const pads = of.map((row) => [Math.max(0, ...row.map((p) => p.pad[before])), Math.max(0, ...row.map((p) => p.pad[after]))]);
        const free = Math.max(total - pads.flat().reduce((a, b) => a + b, 0), 60);
        const shares = of.map((row) => Math.max(...row.map((p) => p.share[index])));
        const sum = shares.reduce((a, b) => a + b, 0);
        let at = 0;
        return shares.map((share, i) => {
          const begin = at + pads[i][0];
          at = begin + (free * share) / sum + pads[i][1];
          return [begin, begin + (free * share) / sum];
        });
      };
      const across = tracks(grid.columns, "column", 0, "left", "right", grid.wide);
      const down = tracks(grid.rows, "row", 1, "top", "bottom", high);
      this.edge = across[grid.columns - 1][1];
      panels.forEach((panel) => {
        [panel.left, panel.right] = across[panel.column];
        panel.room = (panel.column + 1 < grid.columns ? across[panel.column + 1][0] - 8 : grid.wide) - panel.left;
        [panel.top, panel.bottom] = down[panel.row];
        panel.x.span(panel.left, panel.right);
        [panel.y, panel.second].filter(Boolean).forEach((axis) => axis.span(panel.bottom, panel.top));
      });
      return high;
    }

    // Room that turned texts take below an axis.
    slant(axis) {
      const longest = Math.max(0, ...axis.ticks(400).map((row) => width(row[1])));
      axis.turned = axis.options.tickangle || (axis.categories && longest * axis.categories.length > this.width * 0.9) ? 1 : 0;
      return axis.turned ? Math.min(longest, 130) * 0.72 : 0;
    }

    titles(panels) {
      (this.layout.annotations || []).forEach((note) => {
        const near = (panel) => {
          const [across, up] = [panel.x.options.domain, panel.y.options.domain];
          const inside = note.xanchor === "left" ? 0 : note.x < across[0] - 0.01 || note.x > across[1] + 0.01 ? 9 : 0;
          return Math.abs(up[1] - note.y) + inside;
        };
        const best = panels.reduce((a, b) => (near(b) < near(a) ? b : a));
        best.title = plain(note.text);
      });
    }

    draw() {
      this.width = this.box.clientWidth;
      if (!this.width) return;
      const axes = this.axes();
      const panels = this.panels(axes).filter((panel) => panel.y);
      this.settle(axes);
      this.titles(panels);
      const aside = this.layout.legend && this.layout.legend.orientation === "v" && this.width > NARROW + 100 && this.layout.showlegend;
      this.box.classList.toggle("aside", Boolean(aside));
      const wide = this.width - (aside ? 196 : 0);
      const high = this.place(panels, this.grid(panels, wide, this.width < NARROW));
      this.stage.textContent = "";
      const svg = element(this.stage, "svg", { viewBox: `0 0 ${wide} ${high}`, role: "img", "aria-label": this.label, width: wide, height: high });
      this.svg = svg;
      this.axesByName = axes;
      panels.forEach((panel) => this.panel(svg, panel));
      this.drawn = panels;
      this.entries();
      this.back.hidden = !Object.keys(this.zoom).length;
      this.tip.hidden = true;
    }

    panel(svg, panel) {
      const id = `clip${(numbered += 1)}`;
      element(element(element(svg, "defs"), "clipPath", { id }), "rect", { x: panel.left, y: panel.top, width: panel.right - panel.left, height: panel.bottom - panel.top });
      this.rulers(svg, panel);
      const below = element(svg, "g", { "clip-path": `url(#${id})` });
      const box = element(svg, "g", { "clip-path": `url(#${id})` });
      const free = element(svg, "g");
      const own = (this.layout.shapes || []).filter((s) => String(s.xref).split(" ")[0] === panel.x.short);
      own.filter((s) => s.layer === "below").forEach((s) => shape(below, s, panel));
      const barred = panel.traces.filter((t) => t.type === "bar");
      barred.forEach((t, i) => bars(box, free, t, panel, i, barred.length, this.layout.bargap || 0.3));
      panel.traces.filter((t) => t.type === "heatmap").forEach((t) => {
        cells(box, t, panel);
        if (t.showscale !== false) scaleBar(svg, t, this.edge + 8, panel.top, panel.bottom, (numbered += 1));
      });
      own.filter((s) => s.layer !== "below").forEach((s) => shape(box, s, panel));
      let before = null;
      panel.traces.filter((t) => t.type === "scatter").forEach((t) => { scatter(box, free, t, panel, before, this.width); before = t.points; });
    }

    rulers(svg, panel) {
      const { x, y, second, left, right, top, bottom } = panel;
      const line = (d, colour) => element(svg, "path", { d, stroke: colour, fill: "none", "shape-rendering": "crispEdges" });
      if (panel.title) words(svg, left, top - 9, fitting(panel.title, panel.room, 13), { colour: INK, size: 13 });
      if (y.options.visible !== false) {
        const rows = y.ticks(bottom - top);
        const every = y.categories ? Math.ceil((rows.length * 13) / Math.max(bottom - top, 1)) : 1;
        const labels = rows.map((row) => row[1]);
        // Names may be cut short, numbers never.
        const named = y.categories || y.options.tickvals ? fittingAll(labels, panel.pad.left - 8 - (y.options.title.text ? 20 : 0)) : labels;
        rows.forEach(([at], i) => {
          const up = y.at(at);
          if (y.options.showgrid) line(`M${left} ${up.toFixed(1)}H${right}`, RULE);
          if (panel.labels.y && i % every === 0) words(svg, left - 7, up + 4, named[i], { colour: SOFT, size: 12, more: { "text-anchor": "end" } });
        });
        if (y.options.zeroline && y.low < 0 && y.high > 0) line(`M${left} ${y.at(0).toFixed(1)}H${right}`, y.options.zerolinecolor || SOFT);
        this.upright(svg, y.options.title.text, left - panel.pad.left + 11, (top + bottom) / 2, bottom - top);
      }
      if (second) {
        second.ticks(bottom - top).forEach(([at, text]) => words(svg, right + 7, second.at(at) + 4, text, { colour: SOFT, size: 12 }));
        this.upright(svg, second.options.title.text, right + panel.pad.right - 4, (top + bottom) / 2, bottom - top);
      }
      if (x.options.visible === false) return;
      line(`M${left} ${bottom}H${right}`, "#c4cbd2");
      const rows = x.ticks(right - left);
      const longest = Math.max(1, ...rows.map((row) => width(row[1])));
      const every = Math.ceil((rows.length * (x.turned ? 15 : longest + 8)) / Math.max(right - left, 1));
      const named = fittingAll(rows.map((row) => row[1]), 130);
      rows.forEach(([at], i) => {
        const across = x.at(at);
        if (x.options.showgrid) line(`M${across.toFixed(1)} ${top}V${bottom}`, RULE);
        line(`M${across.toFixed(1)} ${bottom}v4`, "#c4cbd2");
        if (!panel.labels.x || i % every) return;
        const turned = x.turned ? { "text-anchor": "end", transform: `rotate(-45 ${across.toFixed(1)} ${bottom + 14})` } : { "text-anchor": "middle" };
        words(svg, across, bottom + (x.turned ? 14 : 17), named[i], { colour: SOFT, size: 12, more: turned });
      });
      if (x.options.zeroline && x.low < 0 && x.high > 0) line(`M${x.at(0).toFixed(1)} ${top}V${bottom}`, x.options.zerolinecolor || SOFT);
      const title = plain(x.options.title.text);
      if (title) words(svg, (left + right) / 2, bottom + panel.pad.bottom - 6, title, { colour: SOFT, size: 12.5, more: { "text-anchor": "middle" } });
    }

    upright(svg, text, x, y, room) {
      if (text) words(svg, x, y, fitting(plain(text), room + 20, 12.5), { colour: SOFT, size: 12.5, more: { "text-anchor": "middle", transform: `rotate(-90 ${x} ${y})` } });
    }

    // A button for each name of the legend, which hides and shows its marks.
    entries() {
      this.legend.textContent = "";
      if (!this.layout.showlegend) return;
      const seen = new Set();
      this.data.filter((t) => t.visible !== false && t.showlegend && t.name).map((t, i) => [t.legendrank ?? 1000, i, t]).sort((a, b) => a[0] - b[0] || a[1] - b[1]).forEach(([, , t]) => {
        const group = t.legendgroup || t.name;
        if (seen.has(t.name)) return;
        seen.add(t.name);
        const button = html(html(this.legend, "li"), "button", { type: "button", "aria-pressed": String(!this.hidden.has(group)) });
        const swatch = element(button, "svg", { width: 26, height: 12, "aria-hidden": "true" });
        if (t.type === "bar") element(swatch, "rect", { x: 4, y: 1, width: 18, height: 10, fill: Array.isArray(t.marker.color) ? t.marker.color[0] : t.marker.color });
        else if (t.type !== "heatmap") {
          if (t.fill) element(swatch, "rect", { x: 0, y: 1, width: 26, height: 10, fill: t.fillcolor });
          if ((t.mode || "").includes("lines") && t.line.width) element(swatch, "path", { d: "M0 6H26", stroke: t.line.color, "stroke-width": t.line.width, "stroke-dasharray": DASHES[t.line.dash] || "none" });
          if ((t.mode || "").includes("markers")) symbols(swatch, { ...t.marker, size: Math.min(t.marker.size, 9) }, [[13, 6]]);
        }
        button.appendChild(document.createTextNode(plain(t.name)));
        button.addEventListener("click", () => {
          if (!this.hidden.delete(group)) this.hidden.add(group);
          const place = [...this.legend.querySelectorAll("button")].indexOf(document.activeElement);
          this.draw();
          if (place >= 0) this.legend.querySelectorAll("button")[place].focus();
        });
      });
    }

    listen() {
      let from = null;
      let frame = null;
      const at = (event) => {
        const edge = this.svg.getBoundingClientRect();
        return [event.clientX - edge.left, event.clientY - edge.top];
      };
      const panelAt = ([x, y]) => this.drawn.find((p) => x >= p.left && x <= p.right && y >= p.top && y <= p.bottom);
      this.stage.addEventListener("pointerdown", (event) => {
        const panel = panelAt(at(event));
        if (event.pointerType !== "mouse" || event.button || !panel) return;
        from = { panel, at: at(event) };
        this.stage.setPointerCapture(event.pointerId);
        event.preventDefault();
      });
      this.stage.addEventListener("pointermove", (event) => {
        if (!from) return this.values(panelAt(at(event)), at(event));
        const [x, y] = at(event);
        if (!frame) frame = element(this.svg, "rect", { fill: "#0b57d0", "fill-opacity": 0.1, stroke: "#0b57d0" });
        const flat = this.flat(from, y);
        const [top, bottom] = flat ? [from.panel.top, from.panel.bottom] : [Math.min(y, from.at[1]), Math.max(y, from.at[1])];
        Object.entries({ x: Math.min(x, from.at[0]), y: top, width: Math.abs(x - from.at[0]), height: bottom - top }).forEach(([k, v]) => frame.setAttribute(k, v));
      });
      this.stage.addEventListener("pointerup", (event) => {
        const begun = from;
        from = null;
        if (frame) frame.remove();
        frame = null;
        if (begun) this.narrow(begun, at(event));
      });
      this.stage.addEventListener("pointerleave", () => { this.tip.hidden = true; });
      this.stage.addEventListener("dblclick", () => this.zoomed({}));
    }

    // Whether a drag means the horizontal axis alone.
    flat(from, y) {
      return Math.abs(y - from.at[1]) < 25;
    }

    narrow(from, [x, y]) {
      if (Math.abs(x - from.at[0]) < 8 && this.flat(from, y)) return;
      const { panel } = from;
      const range = (axis, a, b) => [axis.back(a), axis.back(b)].sort((p, q) => p - q);
      const zoom = { ...this.zoom };
      const name = (axis) => this.leader(this.axesByName, axis.short);
      if (Math.abs(x - from.at[0]) >= 8) zoom[name(panel.x)] = panel.x.reversed ? range(panel.x, x, from.at[0]).reverse() : range(panel.x, x, from.at[0]);
      if (!this.flat(from, y)) zoom[name(panel.y)] = panel.y.reversed ? range(panel.y, y, from.at[1]).reverse() : range(panel.y, y, from.at[1]);
      this.zoomed(zoom);
    }

    // Values under the pointer: of every series at a position, or of the point beside it.
    values(panel, [x, y]) {
      if (!panel) { this.tip.hidden = true; return; }
      const unified = String(this.layout.hovermode || "").includes("unified");
      const near = panel.traces.filter((t) => t.hovertemplate).map((t) => this.nearest(t, panel, x, y, unified)).filter(Boolean);
      const picked = unified ? near.filter((hit) => hit.across < 30) : near.sort((a, b) => a.far - b.far).slice(0, 1).filter((hit) => hit.far < 28);
      if (!picked.length) { this.tip.hidden = true; return; }
      this.tip.textContent = "";
      if (unified) html(this.tip, "b", {}, plain(this.worded(picked[0].x)));
      picked.slice(0, 12).forEach((hit) => {
        const row = html(this.tip, "div");
        const colour = hit.trace.line?.color || (Array.isArray(hit.trace.marker?.color) ? hit.trace.marker.color[hit.i] : hit.trace.marker?.color);
        if (colour) html(row, "i", { style: `background: ${themed(colour)}` });
        html(row, "span", {}, hit.text);
      });
      this.tip.hidden = false;
      const left = Math.min(x + 14, this.width - this.tip.offsetWidth - 4);
      this.tip.style.left = `${Math.max(left < x && y > panel.top + 40 ? Math.min(left, x - this.tip.offsetWidth - 14) : left, 0)}px`;
      this.tip.style.top = `${this.stage.offsetTop + Math.max(y - this.tip.offsetHeight - 10, 0)}px`;
    }

    worded(value) {
      return typeof value === "number" ? number(value, ".4~g") : value;
    }

    nearest(trace, panel, x, y, unified) {
      if (trace.type === "heatmap") {
        const inside = (edges, at) => edges.slice(1).findIndex((edge, i) => (at - edge) * (at - edges[i]) <= 0);
        const [c, r] = [inside(trace.edges[0], x), inside(trace.edges[1], y)];
        if (c < 0 || r < 0 || trace.z[r][c] === null) return null;
        const label = trace.customdata ? trace.customdata[r][c] : "";
        return { trace, i: 0, far: 0, across: 0, x: trace.x[c], text: this.said(trace, { x: trace.x[c], y: trace.y[r], z: trace.z[r][c], customdata: label }) };
      }
      let best = null;
      (trace.boxes || trace.points || []).forEach((p, i) => {
        if (p === null) return;
        const [across, up] = trace.boxes ? [Math.max(p[0] - x, x - p[0] - p[2], 0), Math.max(p[1] - y, y - p[1] - p[3], 0)] : [Math.abs(p[0] - x), Math.abs(p[1] - y)];
        const far = unified ? across : Math.hypot(across, up);
        if (!best || far < best.far) best = { far, across, i };
      });
      if (!best) return null;
      const at = trace.x && trace.x.length ? trace.x[best.i] : trace.x0 + best.i * trace.dx;
      const text = this.said(trace, { x: at, y: trace.y[best.i], customdata: trace.customdata ? trace.customdata[best.i] : "" });
      return { ...best, trace, x: at, text };
    }

    said(trace, fields) {
      const [before, extra] = trace.hovertemplate.split("<extra>");
      const name = extra === undefined ? trace.name || "" : extra.replace("</extra>", "");
      const text = before.replace(/%\{(x|y|z|customdata)(?::([^}]*))?\}/g, (_, key, form) => (typeof fields[key] === "number" ? number(fields[key], form) : String(fields[key])));
      return plain(name ? `${name}<br>${text}` : text).replace(/\n/g, name && !text.includes("<br>") && !name.includes("<br>") ? ": " : "\n");
    }
  }

  return Figure;
})();
