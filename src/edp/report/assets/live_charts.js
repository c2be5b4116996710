"use strict";
/* Plots of a session, by uPlot; those out of sight are not drawn, and `redraw` is called when one comes into it. A plot is { title, unit, lines } and a line { name, values(tick), colour, dashed }. */
function edpCharts(holder, colours, redraw) {
  const POINTS = 1200; // of a line: more than a plot has pixels
  const charts = new Map();
  const seen = new IntersectionObserver((entries) => entries.forEach((entry) => {
    const chart = [...charts.values()].find((one) => one.figure === entry.target);
    if (chart && chart.visible !== entry.isIntersecting) { chart.visible = entry.isIntersecting; redraw(); }
  }));
  // A figure is narrower once another one stands in its row, which is after its plot was made.
  const sized = new ResizeObserver((entries) => entries.forEach((entry) => {
    const chart = [...charts.values()].find((one) => one.figure === entry.target);
    if (chart && chart.plot.width !== widthOf(chart.figure)) { chart.plot.setSize({ width: widthOf(chart.figure), height: chart.plot.height }); redraw(); }
  }));
  const widthOf = (figure) => Math.max(160, figure.clientWidth);
  let span = [0, 1];

  function figure(spec) {
    const box = document.createElement("figure"), caption = document.createElement("figcaption");
    const head = document.createElement("b");
    head.textContent = spec.unit && spec.unit !== "1" ? `${spec.title} [${spec.unit}]` : spec.title;
    caption.append(head);
    const values = spec.lines.filter((line) => !line.bound).map((line) => {
      const entry = document.createElement("span"), key = document.createElement("i"), value = document.createElement("span");
      key.dataset.colour = line.colour;
      if (line.dashed) key.className = "dashed";
      entry.append(key, `${line.name} `, value);
      caption.append(entry);
      return { line, key, value };
    });
    box.append(caption);
    holder.append(box);
    return { box, values };
  }

  function make(spec) {
    const { box, values } = figure(spec);
    const axis = (size) => ({
      stroke: () => colours().soft, grid: { stroke: () => colours().grid, width: 1 }, ticks: { show: false }, font: "11.5px sans-serif", size, gap: 3,
    });
    const bands = spec.lines.findIndex((line) => line.bound === "upper");
    const plot = new uPlot({
      width: widthOf(box), height: spec.height || 150, legend: { show: false }, cursor: { show: false },
      padding: [6, 8, 0, 0],
      scales: { x: { time: false, range: () => span }, y: { range: (u, low, high) => padded(low, high, spec.least) } },
      axes: [{ ...axis(24), values: (u, ticks) => ticks.map((s) => `${+s.toFixed(2)} s`) }, { ...axis(50), space: 26 }],
      series: [{}, ...spec.lines.map((line) => ({
        stroke: line.bound ? "rgba(0,0,0,0)" : () => colours()[line.colour], width: line.bound ? 0 : line.dashed ? 1.5 : 1.3,
        dash: line.dashed ? [4, 3] : undefined, points: { show: false }, spanGaps: false,
      }))],
      bands: bands < 0 ? [] : [{ series: [bands + 1, bands + 2], fill: () => colours().band }],
    }, [[0, 1], ...spec.lines.map(() => [null, null])], box);
    const chart = { figure: box, plot, spec, values, visible: true };
    seen.observe(box); sized.observe(box);
    return chart;
  }
  function padded(low, high, least) {
    if (low === null || high === null) return [0, 1];
    const room = Math.max(0.06 * (high - low), least || 0, 1e-9 * Math.max(Math.abs(low), Math.abs(high)), 1e-12);
    return [low - room, high + room];
  }

  return {
    /* Show these plots, in this order; ones that stay are not made anew. */
    show(specs) {
      const names = new Set(specs.map((spec) => spec.id));
      charts.forEach((chart, id) => {
        if (names.has(id)) return;
        seen.unobserve(chart.figure); sized.unobserve(chart.figure); chart.plot.destroy(); chart.figure.remove(); charts.delete(id);
      });
      specs.forEach((spec) => {
        if (!charts.has(spec.id)) charts.set(spec.id, make(spec));
        charts.get(spec.id).spec = spec;
        charts.get(spec.id).values.forEach((entry) => { entry.line = spec.lines.find((line) => line.name === entry.line.name) || entry.line; });
        holder.append(charts.get(spec.id).figure);
      });
    },
    /* Draw the ticks from first to stop, as they are at tick `now`. */
    draw(first, stop, now, rate) {
      const stride = Math.max(1, Math.ceil((stop - first) / POINTS));
      const from = Math.ceil(first / stride) * stride, x = [];
      for (let tick = from; tick <= stop; tick += stride) x.push(tick / rate);
      span = [first / rate, stop / rate];
      const paint = colours();
      charts.forEach((chart) => {
        if (!chart.visible) return;
        const columns = chart.spec.lines.map((line) => {
          const column = new Array(x.length);
          for (let k = 0, tick = from; k < x.length; k++, tick += stride) { const v = line.values(tick); column[k] = v === v ? v : null; }
          return column;
        });
        chart.plot.setData([x, ...columns]);
        chart.values.forEach(({ line, key, value }) => {
          const v = line.values(now);
          key.style.borderColor = paint[line.colour];
          value.textContent = v === v ? (Math.abs(v) >= 100 ? v.toFixed(0) : v.toPrecision(3)) : "–";
        });
      });
    },
  };
}
