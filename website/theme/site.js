// What scrolls can be scrolled from the keyboard, too.
window.addEventListener("load", () => {
  const scrolling = "pre > code, .md-typeset__scrollwrap, .md-typeset__table, p:has(> img[src*='concept_'])";
  for (const element of document.querySelectorAll(scrolling)) {
    if (element.scrollWidth > element.clientWidth) element.tabIndex = 0;
  }
  // Each block of code has a bar of its own; screen readers tell them apart by their names.
  document.querySelectorAll("nav.md-code__nav").forEach((bar, number) => {
    bar.setAttribute("aria-label", `Code block ${number + 1}`);
  });
});
