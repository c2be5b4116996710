"use strict";
// What stands in a panel, as elements of SVG: lines, symbols, bands, bars, cells, words and guide lines.
const FigureMarks = (function () {
  const { number, plain } = FigureAxes;
  const DASHES = { dash: "7 5", dot: "2 3", dashdot: "7 3 2 3", longdash: "10 5" };
  const SYMBOLS = {
    circle: (r) => `M${-r} 0a${r} ${r} 0 1 0 ${2 * r} 0a${r} ${r} 0 1 0 ${-2 * r} 0Z`,
    diamond: (r) => `M0 ${-1.3 * r}L${1.3 * r} 0L0 ${1.3 * r}L${-1.3 * r} 0Z`,
    square: (r) => `M${-r} ${-r}H${r}V${r}H${-r}Z`,
    "triangle-up": (r) => `M0 ${-1.2 * r}L${1.15 * r} ${0.8 * r}H${-1.15 * r}Z`,
    x: (r) => `M${-r} ${-r}L${r} ${r}M${r} ${-r}L${-r} ${r}`,
    cross: (r) => `M0 ${-1.2 * r}V${1.2 * r}M${-1.2 * r} 0H${1.2 * r}`,
    star: (r) => "M" + Array.from({ length: 10 }, (_, i) => {
      const far = (i % 2 ? 0.55 : 1.35) * r;
      return `${(far * Math.sin((Math.PI * i) / 5)).toFixed(2)} ${(-far * Math.cos((Math.PI * i) / 5)).toFixed(2)}`;
    }).join("L") + "Z",
    "line-ns": (r) => `M0 ${-1.4 * r}V${1.4 * r}`,
    "line-ew": (r) => `M${-1.4 * r} 0H${1.4 * r}`,
  };
  const STROKED = ["x", "cross", "line-ns", "line-ew"];

  // The colour of a drawing in the palette of the page, which knows what stands for it in the dark.
  const themed = (colour) => (/^#[0-9a-f]{6}$/i.test(colour) ? `var(--c${colour.slice(1).toLowerCase()}, ${colour})` : colour);

  function element(parent, name, attributes, text) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    Object.entries(attributes || {}).forEach(([key, value]) => made.setAttribute(key, key === "fill" || key === "stroke" ? themed(value) : value));
    if (text !== undefined) made.textContent = text;
    if (parent) parent.appendChild(made);
    return made;
  }

  function words(parent, x, y, text, look) {
    const made = element(parent, "text", { x: x.toFixed(1), y: y.toFixed(1), fill: look.colour, "font-size": look.size || 12, ...look.more });
    const lines = String(text).split("\n");
    lines.forEach((line, i) => element(made, "tspan", { x: x.toFixed(1), dy: i ? "1.2em" : 0 }, line));
    return made;
  }

  // Points of a series in pixels; gaps are null.
  function pixels(series, panel) {
    const { x, y } = series;
    const down = series.yaxis === panel.second?.short ? panel.second : panel.y;
    return y.map((value, i) => {
      const [across, up] = [panel.x.pixel(x ? x[i] : series.x0 + i * series.dx), down.pixel(value)];
      return Number.isFinite(across) && Number.isFinite(up) ? [across, up] : null;
    });
  }

  function path(points, shape) {
    let text = "";
    let last = null;
    points.forEach((point) => {
      if (point === null) {
        last = null;
        return;
      }
      const [x, y] = [point[0].toFixed(1), point[1].toFixed(1)];
      if (last === null) text += `M${x} ${y}`;
      else if (shape === "hv") text += `H${x}V${y}`;
      else if (shape === "hvh") text += `H${((last[0] + point[0]) / 2).toFixed(1)}V${y}H${x}`;
      else text += `L${x} ${y}`;
      last = point;
    });
    return text;
  }

  function filled(series, points, before, panel) {
    const kept = points.filter(Boolean);
    if (!kept.length) return "";
    const down = series.yaxis === panel.second?.short ? panel.second : panel.y;
    if (series.fill === "tonexty") {
      const other = (before || []).filter(Boolean).reverse();
      return path(kept, series.line.shape) + other.map((p) => `L${p[0].toFixed(1)} ${p[1].toFixed(1)}`).join("") + "Z";
    }
    const zero = Math.min(Math.max(down.pixel(0), panel.top), panel.bottom).toFixed(1);
    return `${path(kept, series.line.shape)}V${zero}H${kept[0][0].toFixed(1)}Z`;
  }

  function scatter(box, free, series, panel, before, wide) {
    const points = pixels(series, panel);
    series.points = points;
    const mode = series.mode || "lines";
    const into = series.cliponaxis === false ? free : box;
    const group = element(into, "g", { opacity: series.opacity === undefined ? 1 : series.opacity });
    if (series.fill) element(group, "path", { d: filled(series, points, before, panel), fill: series.fillcolor, stroke: "none" });
    if (series.error_x) {
      const { array, arrayminus, color } = series.error_x;
      const d = points.map((p, i) => (p === null || array[i] === null ? "" : `M${panel.x.pixel(series.x[i] - arrayminus[i]).toFixed(1)} ${p[1].toFixed(1)}H${panel.x.pixel(series.x[i] + array[i]).toFixed(1)}`)).join("");
      element(group, "path", { d, stroke: color, "stroke-width": 1.4, fill: "none" });
    }
    if (mode.includes("lines")) {
      element(group, "path", {
        d: path(points, series.line.shape), fill: "none", stroke: series.line.color, "stroke-width": series.line.width,
        "stroke-linejoin": "round", "stroke-dasharray": DASHES[series.line.dash] || "none",
      });
    }
    if (mode.includes("markers")) symbols(group, series.marker, points);
    if (mode.includes("text")) {
      const raised = series.textposition === "top right";
      points.forEach((p, i) => {
        if (p === null) return;
        const [text, up] = [plain(series.text[i]), p[1] + (raised ? -7 : 4)];
        const made = words(group, p[0] + 3, up, text, { colour: series.textfont.color });
        const beyond = p[0] + 3 + made.getComputedTextLength() - wide;
        if (beyond > 0) [made, ...made.children].forEach((part) => part.setAttribute("x", Math.max(p[0] + 3 - beyond, 0).toFixed(1)));
      });
    }
  }

  function symbols(group, marker, points) {
    const open = marker.symbol.endsWith("-open");
    const shape = marker.symbol.replace("-open", "");
    const line = open || STROKED.includes(shape);
    const d = (SYMBOLS[shape] || SYMBOLS.circle)(marker.size / 2);
    const edge = marker.line && marker.line.color ? { stroke: marker.line.color, "stroke-width": marker.line.width } : { stroke: "none" };
    const look = line ? { fill: "none", stroke: marker.color, "stroke-width": 1.8 } : { fill: marker.color, ...edge };
    points.forEach((p) => p && element(group, "path", { d, transform: `translate(${p[0].toFixed(1)} ${p[1].toFixed(1)})`, ...look }));
  }

  // Bars: how wide they are depends on how many series share their places.
  function bars(box, free, series, panel, place, count, gap) {
    const lying = series.orientation === "h";
    const [along, reach] = lying ? [panel.y, panel.x] : [panel.x, panel.y];
    const [at, far] = lying ? [series.y, series.x] : [series.x, series.y];
    const places = at.map((value) => along.place(value));
    const sorted = [...new Set(places)].sort((a, b) => a - b);
    const apart = along.categories ? 1 : sorted.slice(1).reduce((least, v, i) => Math.min(least, v - sorted[i]), Infinity);
    const width = ((1 - gap) * (Number.isFinite(apart) ? apart : 1)) / count;
    series.boxes = places.map((middle, i) => {
      if (far[i] === null || !Number.isFinite(middle) || !Number.isFinite(Number(far[i]))) return null;
      const edges = [0, 1].map((side) => along.at(middle + width * (place + side - count / 2)));
      const ends = [reach.at(Math.min(Math.max(reach.place(reach.log ? 10 ** reach.low : 0), reach.low), reach.high)), reach.pixel(far[i])];
      const [a, b, c, d] = [Math.min(...edges), Math.abs(edges[1] - edges[0]), Math.min(...ends), Math.abs(ends[1] - ends[0])];
      const colours = series.marker.color;
      const fill = Array.isArray(colours) ? colours[i] : colours;
      const [x, y, w, h] = lying ? [c, a, d, b] : [a, c, b, d];
      element(box, "rect", { x: x.toFixed(1), y: y.toFixed(1), width: w.toFixed(1), height: h.toFixed(1), fill });
      const error = series.error_x || series.error_y;
      const [middlePixel, up] = [(edges[0] + edges[1]) / 2, far[i] >= 0];
      if (error && error.array[i] !== null) {
        const [from, to] = [reach.pixel(far[i] - error.arrayminus[i]), reach.pixel(far[i] + error.array[i])].map((v) => v.toFixed(1));
        const line = lying ? `M${from} ${middlePixel.toFixed(1)}H${to}` : `M${middlePixel.toFixed(1)} ${from}V${to}`;
        element(box, "path", { d: line, stroke: error.color, "stroke-width": 1.4 });
      }
      if (series.texttemplate) {
        const text = number(far[i], ".3~g");
        if (lying) words(free, ends[1] + (up ? 5 : -5), middlePixel + 4, text, { colour: "#26303a", more: up ? {} : { "text-anchor": "end" } });
        else words(free, middlePixel, ends[1] + (up ? -5 : 14), text, { colour: "#26303a", more: { "text-anchor": "middle" } });
      }
      return [x, y, w, h];
    });
  }

  function mixed(scale, share) {
    const next = Math.max(scale.findIndex(([at]) => at >= share), 1);
    const [[low, from], [high, to]] = [scale[next - 1], scale[next]];
    const part = high > low ? (share - low) / (high - low) : 0;
    const channel = (text, i) => parseInt(text.slice(1 + 2 * i, 3 + 2 * i), 16);
    const rgb = [0, 1, 2].map((i) => Math.round(channel(from, i) + part * (channel(to, i) - channel(from, i))));
    return { text: `rgb(${rgb.join(",")})`, dark: 0.299 * rgb[0] + 0.587 * rgb[1] + 0.114 * rgb[2] < 140 };
  }

  // Edges of the cells around their middles.
  function edges(axis, at) {
    const places = at.map((value) => axis.place(value));
    const half = places.length > 1 ? (places[1] - places[0]) / 2 : 0.5;
    return [places[0] - half, ...places.slice(1).map((v, i) => (v + places[i]) / 2), places[places.length - 1] + half].map((v) => axis.at(v));
  }

  function cells(box, series, panel) {
    const [across, up] = [edges(panel.x, series.x), edges(panel.y, series.y)];
    series.edges = [across, up];
    const group = element(box, "g", { class: "scaled" });
    series.z.forEach((row, r) => row.forEach((value, c) => {
      if (value === null || !Number.isFinite(value)) return;
      const share = Math.min(Math.max((value - series.zmin) / (series.zmax - series.zmin || 1), 0), 1);
      const [x, y] = [Math.min(across[c], across[c + 1]), Math.min(up[r], up[r + 1])];
      const [w, h] = [Math.abs(across[c + 1] - across[c]), Math.abs(up[r + 1] - up[r])];
      const fill = mixed(series.colorscale, share);
      const less = series.xgap ? 1 : -0.3; // a little overlap hides seams between cells without gaps
      element(group, "rect", { x: x.toFixed(1), y: y.toFixed(1), width: Math.max(w - less, 0.5).toFixed(1), height: Math.max(h - less, 0.5).toFixed(1), fill: fill.text });
      if (series.texttemplate && w > 24 && h > 10) {
        words(group, x + w / 2, y + h / 2 + 3.5, value.toFixed(2), { colour: fill.dark ? "#fff" : "rgb(38, 48, 58)", size: 9, more: { "text-anchor": "middle" } });
      }
    }));
  }

  function scaleBar(svg, series, x, top, bottom, number_) {
    const id = `scale${number_}`;
    const shade = element(element(svg, "defs"), "linearGradient", { id, x1: 0, y1: 1, x2: 0, y2: 0 });
    series.colorscale.forEach(([at, colour]) => element(shade, "stop", { offset: at, "stop-color": colour }));
    top += 16; // the unit stands above
    element(svg, "rect", { x, y: top, width: 10, height: bottom - top, fill: `url(#${id})`, class: "scaled" });
    const axis = new FigureAxes.Axis("y", { ...series.colorbar, range: [series.zmin, series.zmax], type: "-" });
    axis.settle();
    axis.span(bottom, top);
    axis.ticks(bottom - top).forEach(([at, text]) => words(svg, x + 14, axis.at(at) + 4, text, { colour: "#26303a", size: 11 }));
    const unit = plain(series.colorbar.title.text).replace(/\n/g, " ");
    words(svg, x + 56, top - 9, unit, { colour: "#5b6671", size: 11, more: { "text-anchor": "end" } });
  }

  // A guide line or a stripe; its free direction spans the panel.
  function shape(box, given, panel) {
    const side = (name, axis, edges_) => ["0", "1"].map((end) => (String(given[`${name}ref`]).includes("domain") ? edges_[Number(end)] : axis.pixel(given[name + end])));
    const [x0, x1] = side("x", panel.x, [panel.left, panel.right]);
    const [y0, y1] = side("y", panel.y, [panel.top, panel.bottom]);
    if (![x0, x1, y0, y1].every(Number.isFinite)) return;
    if (given.type === "rect") {
      element(box, "rect", { x: Math.min(x0, x1), y: Math.min(y0, y1), width: Math.abs(x1 - x0), height: Math.abs(y1 - y0), fill: given.fillcolor });
    } else {
      element(box, "path", { d: `M${x0} ${y0}L${x1} ${y1}`, stroke: given.line.color, "stroke-width": given.line.width, "stroke-dasharray": DASHES[given.line.dash] || "none" });
    }
  }

  return { bars, cells, element, scaleBar, scatter, shape, symbols, themed, words, DASHES };
})();
