"use strict";
// Draws every figure of the page, and shows of its traces those that the selectors above it ask for.
(function () {
  const config = {
    displaylogo: false,
    plotlyServerURL: "", // nothing on this page may leave it: no "share chart" that uploads the data
    showSendToCloud: false,
    responsive: true,
    modeBarButtonsToRemove: ["sendChartToCloud", "sendDataToCloud", "select2d", "lasso2d", "autoScale2d", "zoomIn2d", "zoomOut2d"],
    toImageButtonOptions: { scale: 2 },
  };

  function chosen(selectors) {
    return Object.fromEntries(selectors.map((selector) => [selector.dataset.key, selector.value]));
  }

  function apply(box, spec, selectors, changed) {
    const want = chosen(selectors);
    const visible = box.data.map((trace) =>
      Object.entries(trace.meta || {}).every(([key, value]) => !(key in want) || want[key] === value));
    const layout = {};
    if (!spec.controls[changed]) {
      Object.keys(box.layout).filter((name) => /^[xy]axis\d*$/.test(name)).forEach((name) => {
        layout[name + ".autorange"] = true;
      });
    }
    Plotly.update(box, { visible: visible }, layout);
  }

  function draw(spec) {
    const box = document.getElementById("figure-" + spec.name);
    const selectors = Array.from(document.querySelectorAll('select[data-figure="' + spec.name + '"]'));
    const drawn = Plotly.newPlot(box, spec.figure.data, spec.figure.layout, config);
    selectors.forEach((selector) =>
      selector.addEventListener("change", () => drawn.then(() => apply(box, spec, selectors, selector.dataset.key))));
  }

  JSON.parse(document.getElementById("figures").textContent).forEach(draw);

  // Paper shows what a click would: every folded part but the configuration.
  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details:not(.long)").forEach((part) => { part.open = true; });
  });
})();
