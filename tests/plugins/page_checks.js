// What every page must keep, as a list of sentences about what it does not keep. Evaluated in the page.
(() => {
  const faults = [];
  const say = (what, node) => faults.push(node ? `${what}: ${node.outerHTML.slice(0, 120)}` : what);
  const shown = (node) => node.getClientRects().length > 0 && node.checkVisibility({ visibilityProperty: true });

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
    table.querySelectorAll("thead th").forEach((heading) => {
      const texts = document.createTreeWalker(heading, NodeFilter.SHOW_TEXT);
      while (shown(heading) && texts.nextNode()) for (const word of texts.currentNode.data.matchAll(/[^\s-]{2,14}(?=[\s-]|$)/g)) {
        const range = document.createRange();
        range.setStart(texts.currentNode, word.index);
        range.setEnd(texts.currentNode, word.index + word[0].length);
        if (new Set([...range.getClientRects()].map((line) => Math.round(line.top))).size > 1) say("word of a heading is broken", heading);
      }
    });
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
    const [a, b] = [light(ink), light(ground(drawing || node))];
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    const large = parseFloat(style.fontSize) >= 24 || (parseFloat(style.fontSize) >= 18.6 && Number(style.fontWeight) >= 600);
    const key = `${ink}/${node.className}`;
    if (ratio < (large ? 3 : 4.5) && !said.has(key)) { said.add(key); say(`contrast ${ratio.toFixed(2)}`, node); }
  }
  // What is drawn or written at one place is not at another's: boxes, as far as their containers show them.
  const visible = (node) => {
    let { left, top, right, bottom } = node.getBoundingClientRect();
    for (let at = node.parentElement; at; at = at.parentElement) {
      if (getComputedStyle(at).overflow === "visible") continue;
      const edge = at.getBoundingClientRect();
      [left, top, right, bottom] = [Math.max(left, edge.left), Math.max(top, edge.top), Math.min(right, edge.right), Math.min(bottom, edge.bottom)];
    }
    return { left, top, right, bottom };
  };
  const lifted = (node) => {
    for (let at = node; at && at !== document.body; at = at.parentElement) {
      if (/absolute|fixed|sticky/.test(getComputedStyle(at).position)) return true;
    }
    return false;
  };
  const parts = [...document.querySelectorAll("figure, .figure, .wide, canvas, svg, table, button, select, input, output, h1, h2, h3, p, li, dt, dd, figcaption, legend, nav a, summary, pre, meter")]
    .filter((node) => shown(node) && !node.closest("svg svg") && !lifted(node))
    .map((node) => ({ node, box: visible(node) })).filter(({ box }) => box.right - box.left > 1 && box.bottom - box.top > 1);
  parts.forEach((one, i) => parts.slice(i + 1).forEach((other) => {
    if (one.node.contains(other.node) || other.node.contains(one.node)) return;
    const across = Math.min(one.box.right, other.box.right) - Math.max(one.box.left, other.box.left);
    const down = Math.min(one.box.bottom, other.box.bottom) - Math.max(one.box.top, other.box.top);
    if (across > 1.5 && down > 1.5) say(`overlap of ${Math.round(across)} x ${Math.round(down)} with ${other.node.outerHTML.slice(0, 80)}`, one.node);
  }));
  // Drawings of plots have canvases that lie absolutely within them: each stays within its figure.
  document.querySelectorAll("figure canvas, .figure svg[role=img]").forEach((node) => {
    const [inner, outer] = [node.getBoundingClientRect(), node.closest("figure, .figure").getBoundingClientRect()];
    if (shown(node) && (inner.right > outer.right + 1.5 || inner.left < outer.left - 1.5 || inner.bottom > outer.bottom + 1.5)) say("drawing leaves its figure", node);
  });
  // Words of a drawing that lie level do not cover each other.
  document.querySelectorAll("svg[role=img]").forEach((drawing) => {
    const level = [...drawing.querySelectorAll("text")].filter((text) => shown(text) && !text.hasAttribute("transform") && text.textContent.trim() && !text.closest("g[clip-path]"))
      .map((text) => ({ text, box: text.getBoundingClientRect() }));
    level.forEach((one, i) => level.slice(i + 1).forEach((other) => {
      const across = Math.min(one.box.right, other.box.right) - Math.max(one.box.left, other.box.left);
      const down = Math.min(one.box.bottom, other.box.bottom) - Math.max(one.box.top, other.box.top);
      if (across > 3 && down > 5) say(`words "${one.text.textContent}" and "${other.text.textContent}" overlap`, drawing);
    }));
  });
  document.querySelectorAll("svg text").forEach((text) => {
    if (/^[\u2212\d.,]+\u2026[\d.,]*$/.test(text.textContent.trim())) say("number cut short", text);
  });
  document.querySelectorAll("td, th").forEach((cell) => {
    if (shown(cell) && cell.textContent.trim().length > 3 && cell.getBoundingClientRect().width < 24) say("narrow cell", cell);
  });
  return faults;
})()
