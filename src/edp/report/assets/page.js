"use strict";
// Draws the figures of the page as they come into sight, and shows of each what the selectors above it ask for.
(function () {
  const specs = JSON.parse(document.getElementById("figures").textContent);
  const waiting = new Map();

  function draw(box) {
    const make = waiting.get(box);
    waiting.delete(box);
    if (make) make();
  }

  function prepare(spec) {
    const box = document.getElementById("figure-" + spec.name);
    const selectors = Array.from(document.querySelectorAll('select[data-figure="' + spec.name + '"]'));
    const section = box.closest("section");
    const heading = section && section.querySelector("h2");
    const names = [...new Set(spec.figure.data.map((trace) => FigureAxes.plain(trace.name)).filter(Boolean))];
    const label = (heading ? heading.textContent : spec.name) + (names.length ? ": " + names.slice(0, 12).join(", ") : "");
    let figure = null;
    waiting.set(box, () => { figure = new Figure(box, spec, label); });
    selectors.forEach((selector) => selector.addEventListener("change", () => {
      draw(box);
      figure.choose(Object.fromEntries(selectors.map((one) => [one.dataset.key, one.value])), spec.controls[selector.dataset.key]);
    }));
    return box;
  }

  const seen = new IntersectionObserver((rows) => {
    rows.filter((row) => row.isIntersecting).forEach((row) => { seen.unobserve(row.target); draw(row.target); });
  }, { rootMargin: "600px" });
  specs.map(prepare).forEach((box) => seen.observe(box));

  // Paper shows what a click would: every figure, and every folded part but the configuration.
  window.addEventListener("beforeprint", () => {
    document.querySelectorAll("details:not(.long)").forEach((part) => { part.open = true; });
    [...waiting.keys()].forEach(draw);
  });
})();
