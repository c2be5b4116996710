// What every page must keep, as a list of sentences about what it does not keep. Evaluated in the page.
(() => {
  const faults = [];
  const say = (what, node) => faults.push(node ? `${what}: ${node.outerHTML.slice(0, 120)}` : what);
  const shown = (node) => node.getClientRects().length > 0 && getComputedStyle(node).visibility !== "hidden";

  if (!document.documentElement.lang) say("no language");
  if (!document.title.trim()) say("no title");
  if (document.querySelectorAll("h1").length !== 1) say("not one h1");
  if (document.querySelectorAll("main").length !== 1) say("not one main");
  let level = 0;
  document.querySelectorAll("h1, h2, h3, h4").forEach((heading) => {
    const now = Number(heading.tagName[1]);
    if (now > level + 1) say(`heading h${now} after h${level}`, heading);
    if (!heading.textContent.trim()) say("empty heading", heading);
    level = now;
  });
  const ids = [...document.querySelectorAll("[id]")].map((node) => node.id);
  ids.filter((id, i) => ids.indexOf(id) !== i).forEach((id) => say(`id twice: ${id}`));
  document.querySelectorAll("a[href^='#']").forEach((link) => {
    if (!document.getElementById(decodeURIComponent(link.hash.slice(1)))) say("link to nothing", link);
  });
  document.querySelectorAll("select, input, textarea").forEach((field) => {
    if (!(field.labels && field.labels.length) && !field.getAttribute("aria-label")) say("field without a label", field);
  });
  document.querySelectorAll("button, summary, a").forEach((control) => {
    if (!control.textContent.trim() && !control.getAttribute("aria-label")) say("control without a name", control);
  });
  document.querySelectorAll("img").forEach((image) => { if (!image.hasAttribute("alt")) say("picture without words", image); });
  document.querySelectorAll("svg, canvas").forEach((drawing) => {
    if (!drawing.getAttribute("aria-label") && drawing.getAttribute("aria-hidden") !== "true" && !drawing.closest("[aria-label]") && !drawing.closest("figure")?.querySelector("figcaption")) say("drawing without words", drawing);
  });
  document.querySelectorAll("table").forEach((table) => {
    if (!table.querySelector("th[scope]")) say("table without headings", table);
  });
  document.querySelectorAll(".figure").forEach((figure) => {
    if (figure.querySelectorAll("svg[role=img] path, svg[role=img] rect").length < 3) say("figure without a drawing", figure);
  });
  document.querySelectorAll("main *, header *").forEach((node) => {
    const style = getComputedStyle(node);
    if (/auto|scroll/.test(style.overflowX) && node.scrollWidth > node.clientWidth + 1 && shown(node)
        && node.tabIndex < 0 && !node.querySelector("a, button, select, [tabindex]")) say("scrolls, but not by keys", node);
  });

  const numbers = (text) => (text.match(/[\d.]+/g) || []).map(Number);
  const light = ([r, g, b]) => [r, g, b].map((v) => v / 255).map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const ground = (node) => {
    for (let at = node; at; at = at.parentElement) {
      const colour = numbers(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] > 0.99) return colour;
    }
    return [255, 255, 255];
  };
  const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  const said = new Set();
  while (walker.nextNode()) {
    const node = walker.currentNode.parentElement;
    if (!walker.currentNode.data.trim() || !shown(node) || /SCRIPT|STYLE/.test(node.tagName)) continue;
    const drawing = node.closest("svg");
    if (drawing && node.closest("g[clip-path]")) continue; // words on cells, whose ground is not the page's
    const style = getComputedStyle(node);
    const ink = numbers(drawing ? style.fill : style.color);
    const [a, b] = [light(ink), light(drawing ? [255, 255, 255] : ground(node))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const large = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.6 && Number(style.fontWeight) >= 600);
    const key = `${ink}/${node.className}`;
    if (ratio < (large ? 3 : 4.5) && !said.has(key)) { said.add(key); say(`contrast ${ratio.toFixed(2)}`, node); }
  }
  return faults;
})()
