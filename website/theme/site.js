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

// A table with a column of tags can be filtered by tag.
window.addEventListener("load", () => {
  for (const table of document.querySelectorAll(".md-typeset table")) {
    const column = [...table.querySelectorAll("th")].findIndex((head) => head.textContent.trim() === "Tags");
    if (column < 0) continue;
    const rows = [...table.querySelectorAll("tbody tr")].map((row) => ({ row, tags: row.cells[column].textContent.trim().split(", ") }));
    const label = document.createElement("label"), choice = document.createElement("select"), count = document.createElement("output");
    label.className = "edp-filter";
    for (const tag of ["all", ...[...new Set(rows.flatMap((one) => one.tags))].sort()]) choice.add(new Option(tag));
    const show = () => {
      for (const { row, tags } of rows) row.hidden = choice.value !== "all" && !tags.includes(choice.value);
      count.textContent = `${rows.filter((one) => !one.row.hidden).length} of ${rows.length} rows`;
    };
    choice.addEventListener("change", show);
    label.append("Tag ", choice, " ", count);
    (table.closest(".md-typeset__scrollwrap") || table).before(label);
    show();
  }
});

// Versions beside this one, where the site was built with them: a script lists them, which files can load, too.
(() => {
  const own = window.edpVersion, script = document.currentScript;
  if (!own || !script) return;
  const base = new URL("../..", script.src).href, root = new URL("../", script.src).href;
  const list = document.createElement("script");
  list.src = `${base}versions.js`;
  list.addEventListener("load", () => {
    const label = document.createElement("label"), choice = document.createElement("select"), name = document.createElement("span");
    label.className = "edp-versions";
    name.textContent = "Version";
    (window.edpVersions || [own]).forEach((version) => {
      const option = document.createElement("option");
      option.value = option.textContent = version;
      option.selected = version === own;
      choice.append(option);
    });
    choice.addEventListener("change", () => {
      // The same page there: one that an older version lacks is the reader's to find from its first page.
      const page = location.href.startsWith(root) ? location.href.slice(root.length) : "index.html";
      location.href = `${base}${choice.value}/${page || "index.html"}`;
    });
    label.append(name, choice);
    (document.querySelector(".md-header__title") || document.body).after(label);
  });
  document.head.append(list);
})();

// A page that was opened as a file may not load the worker of the search; search.js holds its text, and the index.
if (location.protocol === "file:" && window.Worker) {
  const Native = window.Worker;
  window.Worker = function (address, options) {
    const text = (window.edpWorkers || {})[String(address).split("/").pop()];
    return new Native(text ? URL.createObjectURL(new Blob([text], { type: "text/javascript" })) : address, options);
  };
}
