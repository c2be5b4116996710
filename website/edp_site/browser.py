"""The built site in a headless Chromium: accessibility by axe-core, requests to elsewhere, and width on a phone.

The pages are served from this process, which adds a script to each; the script reports and goes on to the next page.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
# Everything that a page may load; whatever else it asks for is reported by the browser itself.
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' data: blob:; "
    "worker-src 'self' blob:; report-uri /__outside"
)
SEARCH = """
const pause = (ms) => new Promise((done) => setTimeout(done, ms));
const roots = (root) => [root, ...[...root.querySelectorAll("*")].filter((one) => one.shadowRoot)
  .flatMap((one) => roots(one.shadowRoot))];
const search = async (words) => { // the theme's search lies in a shadow tree, and its index is read by a worker
  document.querySelector(".md-search__button").click();
  for (let round = 0; round < 40; round += 1) {
    await pause(500);
    const [, ...shadows] = roots(document);
    const field = shadows.flatMap((root) => [...root.querySelectorAll("input")]).find((one) => one.autofocus);
    if (field && field.value !== words) {
      field.value = words;
      field.dispatchEvent(new Event("input", {bubbles: true}));
    }
    const found = shadows.flatMap((root) => [...root.querySelectorAll("a")].map((one) => one.getAttribute("href")));
    if (found.length) return found;
  }
  return [];
};
"""
"""Scripts: ``search(words)`` gives the links that the search of the page finds."""
_SCRIPT = """
<style>* { transition: none !important; animation: none !important; }</style>
<script src="/__axe.js"></script>
<script>
@SEARCH@window.addEventListener("load", async () => {
  const job = await (await fetch("/__job")).json();
  if (job.scheme) document.body.setAttribute("data-md-color-scheme", job.scheme);
  await pause(300); // scripts of the page wrap tables and draw icons
  const judged = await axe.run(document, {resultTypes: ["violations"]});
  const elsewhere = performance.getEntriesByType("resource").map((entry) => entry.name)
    .filter((name) => !name.startsWith(location.origin) && !name.startsWith("data:") && !name.startsWith("blob:"));
  const wide = document.documentElement.scrollWidth - document.documentElement.clientWidth;
  const violations = judged.violations.map((one) => ({
    id: one.id, impact: one.impact, help: one.help,
    nodes: one.nodes.slice(0, 5).map((node) =>
      `${node.html.slice(0, 200)} ${(node.any[0] || {}).message || ''}`), count: one.nodes.length,
  }));
  const words = job.words ? await search(job.words) : [];
  const next = await (await fetch("/__found", {method: "POST",
    body: JSON.stringify({violations, elsewhere, wide, words: words})})).json();
  if (next.page) location.href = next.page;
});
</script>
""".replace("@SEARCH@", SEARCH)


@dataclass
class Visit:
    """What one page gave.

    Attributes:
        page: its name.
        violations: of axe-core: id, impact, help, nodes.
        elsewhere: what it loaded, or tried to load, that is not of the site.
        wide: pixels by which it is wider than the window.
        words: pages that its search finds, where it was asked to search.
    """

    page: str
    violations: list[dict[str, Any]] = field(default_factory=list)
    elsewhere: list[str] = field(default_factory=list)
    wide: int = 0
    words: list[str] = field(default_factory=list)

    def serious(self) -> list[str]:
        """Violations that axe-core calls serious or critical."""
        return [
            f"{self.page}: {one['id']} ({one['count']}): {one['help']}: {one['nodes'][:2]}"
            for one in self.violations
            if one["impact"] in ("serious", "critical")
        ]


def browser() -> str | None:
    """Return the path of a Chromium; None without one."""
    return next((found for name in BROWSERS if (found := shutil.which(name))), None)


def visit(
    site: Path,
    pages: Sequence[str],
    axe: Path,
    scheme: str = "",
    width: int = 1280,
    words: str = "",
    timeout_s: float = 240.0,
) -> list[Visit]:
    """Open pages of a built site one after the other in one browser.

    Args:
        site: folder of the site.
        pages: their names in it.
        axe: axe-core's ``axe.min.js``.
        scheme: colour scheme of the theme, such as ``slate`` (dark); empty: as the page opens.
        width: of the window in pixels.
        words: to search for on each page; empty: nothing.
        timeout_s: after which the browser is stopped.

    Raises:
        TimeoutError: pages are missing then; says which is the first.
    """
    queue = _Queue(site, list(pages), axe, scheme, words)
    with _served(queue) as address, tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        started = [
            str(browser()), "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--mute-audio",
            "--disable-background-networking", "--disable-component-update", "--disable-sync",
            "--disable-dev-shm-usage", f"--user-data-dir={profile}", f"--window-size={width},900",
            f"{address}/{pages[0]}",
        ]  # fmt: skip
        process = subprocess.Popen(
            started, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        try:
            done = queue.done.wait(timeout_s)
        finally:
            os.killpg(process.pid, signal.SIGTERM)  # with the processes that it started, which write into the profile
            process.wait(30)
    if not done:
        raise TimeoutError(f"the browser did not get beyond {queue.pages[len(queue.visits)]} in {timeout_s:g} s")
    return queue.visits


class _Queue:
    """What is left to be opened, and what was found."""

    def __init__(self, site: Path, pages: list[str], axe: Path, scheme: str, words: str) -> None:
        self.site, self.pages, self.axe, self.scheme, self.words = site, pages, axe, scheme, words
        self.visits: list[Visit] = []
        self.reported: list[str] = []
        self.done = threading.Event()

    def take(self, found: dict[str, Any]) -> str | None:
        """Keep what a page gave; the page to go on with."""
        elsewhere = [*found["elsewhere"], *self.reported]
        self.reported = []
        page = self.pages[len(self.visits)]
        self.visits.append(Visit(page, found["violations"], elsewhere, found["wide"], found["words"]))
        if len(self.visits) < len(self.pages):
            return f"/{self.pages[len(self.visits)]}"
        self.done.set()
        return None


class _Handler(SimpleHTTPRequestHandler):
    def __init__(self, *given: Any, queue: _Queue, **others: Any) -> None:
        self.queue = queue
        super().__init__(*given, directory=str(queue.site), **others)

    def do_GET(self) -> None:
        if self.path == "/__axe.js":
            self._send(self.queue.axe.read_bytes(), "text/javascript")
        elif self.path == "/__job":
            self._send(
                json.dumps({"scheme": self.queue.scheme, "words": self.queue.words}).encode(), "application/json"
            )
        elif self.path.partition("?")[0].endswith(".html") and Path(self.translate_path(self.path)).is_file():
            text = Path(self.translate_path(self.path)).read_text(encoding="utf-8")
            self._send(text.replace("</body>", f"{_SCRIPT}</body>").encode(), "text/html; charset=utf-8")
        else:
            super().do_GET()

    def do_POST(self) -> None:
        body = self.rfile.read(int(self.headers["Content-Length"]))
        if self.path == "/__outside":
            self.queue.reported.append(str(json.loads(body).get("csp-report", {}).get("blocked-uri")))
            self._send(b"{}", "application/json")
        else:
            self._send(json.dumps({"page": self.queue.take(json.loads(body))}).encode(), "application/json")

    def _send(self, body: bytes, kind: str) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Security-Policy-Report-Only", _POLICY)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Say nothing of each request."""


@contextmanager
def _served(queue: _Queue) -> Iterator[str]:
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(_Handler, queue=queue))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
