"""Opens pages in headless Chromium, at the width of a phone or of a desk, and asks them questions.

Chromium is driven by its own protocol over two pipes, so that no further package is needed and no port is opened.
"""

from __future__ import annotations

import base64
import importlib.util
import itertools
import json
import os
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

FLAGS = (
    "--headless=new", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--no-first-run", "--mute-audio",
    "--disable-background-networking", "--disable-component-update", "--disable-extensions", "--hide-scrollbars",
    # No name is looked up: pages are files, or of a server of this machine.
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)  # fmt: skip
PHONE, DESK = (390, 844), (1280, 900)
"""Width and height in pixels of the page's own."""


class Browser:
    """One headless Chromium with one page.

    Args:
        executable: Chromium.
        folder: for its profile.
    """

    def __init__(self, executable: str, folder: Path) -> None:
        from_us, to_browser = os.pipe()
        from_browser, to_us = os.pipe()
        self._write, self._read = to_browser, from_browser
        # Chromium reads descriptor 3 and writes descriptor 4; the pipes are moved there without touching this process.
        script = f'exec "$0" "$@" 3<&{from_us} 4>&{to_us}'
        self._process = subprocess.Popen(
            ["bash", "-c", script, executable, *FLAGS, f"--user-data-dir={folder}", "about:blank"],
            pass_fds=(from_us, to_us),
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(from_us)
        os.close(to_us)
        self._numbers, self._rest = itertools.count(1), b""
        self.events: list[dict[str, Any]] = []
        target = next(t for t in self._ask("Target.getTargets", {})["targetInfos"] if t["type"] == "page")
        self._session = self._ask("Target.attachToTarget", {"targetId": target["targetId"], "flatten": True})[
            "sessionId"
        ]
        for domain in ("Page", "Runtime", "Log", "Network", "Performance"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> dict[str, Any]:
        """One call of the protocol to the page."""
        return self._ask(method, parameters, self._session)

    def open(self, page: Path | str, size: tuple[int, int] = DESK, phone: bool = False) -> None:
        """Load a file or an address in a window of a size; returns once its scripts have run and it is drawn."""
        self.size(*size, phone)
        self.events.clear()
        self.ask("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        self._until("Page.loadEventFired")
        self.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")

    def size(self, width: int, height: int, phone: bool = False, dark: bool = False) -> None:
        """Change the window, and whether the system is dark."""
        self.ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=phone)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.ask("Emulation.setEmulatedMedia", features=[scheme])

    def run(self, script: str) -> Any:
        """The value of an expression in the page; a promise is waited for."""
        answer = self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise AssertionError(json.dumps(answer["exceptionDetails"])[:2000])
        return answer["result"].get("value")

    def wait(self, condition: str, seconds: float = 60.0) -> None:
        """Return once an expression is true in the page."""
        end = time.monotonic() + seconds
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > end:
                raise AssertionError(f"never true: {condition}")
            time.sleep(0.05)

    def press(self, key: str) -> None:
        """A key, such as ``Tab``."""
        code = {"Tab": 9, "Enter": 13}.get(key, 0)
        for kind in ("keyDown", "keyUp"):
            self.ask("Input.dispatchKeyEvent", type=kind, key=key, code=key, windowsVirtualKeyCode=code)

    def processor_s(self) -> float:
        """Processor seconds of the page's process since it was opened; other programs on the machine do not count."""
        return {row["name"]: row["value"] for row in self.ask("Performance.getMetrics")["metrics"]}["ProcessTime"]

    def complaints(self) -> list[str]:
        """Errors of scripts, refused requests and messages of errors since the page was opened."""
        self.run("0")
        said = []
        for event in self.events:
            kind, what = event["method"], event["params"]
            if kind == "Runtime.exceptionThrown":
                said.append(str(what["exceptionDetails"].get("exception", what["exceptionDetails"]))[:500])
            elif kind == "Log.entryAdded" and what["entry"]["level"] == "error":
                said.append(what["entry"]["text"])
        return said

    def requests(self) -> list[str]:
        """Addresses that the page asked for, itself and what it holds left out."""
        asked = [e["params"]["request"]["url"] for e in self.events if e["method"] == "Network.requestWillBeSent"]
        return [url for url in asked if not url.startswith(("file:", "data:", "blob:", "about:"))]

    def picture(self, path: Path, whole: bool = True) -> Path:
        """The page as a PNG file."""
        shot = self.ask("Page.captureScreenshot", captureBeyondViewport=whole)
        path.write_bytes(base64.b64decode(shot["data"]))
        return path

    def printed(self, path: Path) -> Path:
        """The page as it would be printed, as a PDF file."""
        path.write_bytes(base64.b64decode(self.ask("Page.printToPDF", printBackground=False)["data"]))
        return path

    def close(self) -> None:
        """End Chromium."""
        os.close(self._write)
        try:
            self._process.wait(10)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        os.close(self._read)

    def _ask(self, method: str, parameters: dict[str, Any], session: str | None = None) -> dict[str, Any]:
        number = next(self._numbers)
        message = {"id": number, "method": method, "params": parameters} | ({"sessionId": session} if session else {})
        data = json.dumps(message).encode() + b"\0"
        while data:
            data = data[os.write(self._write, data) :]
        while True:
            answer = self._next()
            if answer.get("id") == number:
                if "error" in answer:
                    raise AssertionError(f"{method}: {answer['error']}")
                return dict(answer["result"])
            self.events.append(answer)

    def _until(self, method: str) -> None:
        while not any(event.get("method") == method for event in self.events):
            self.events.append(self._next())

    def _next(self, seconds: float = 120.0) -> dict[str, Any]:
        while b"\0" not in self._rest:
            if not select.select([self._read], [], [], seconds)[0]:
                raise AssertionError("Chromium does not answer")
            piece = os.read(self._read, 1 << 20)
            if not piece:
                raise AssertionError("Chromium ended")
            self._rest += piece
        message, _, self._rest = self._rest.partition(b"\0")
        return dict(json.loads(message))


PAGE_BYTES = 3_000_000
CHECKS = Path(__file__).with_name("page_checks.js")
AXE = "EDP_AXE"
"""Variable that names ``axe.min.js`` of axe-core; without it that of the package axe-core-python."""


def check_page(browser: Browser, page: Path, calls: int = 0) -> None:
    """What every page of EDP keeps: small, whole, quiet, on a phone and at a desk, for eyes, keys and screen readers.

    Args:
        browser: an open browser.
        page: an HTML file.
        calls: how many requests it may make; pages make none.
    """
    assert page.stat().st_size < PAGE_BYTES
    faults = []
    for size, phone in ((DESK, False), (PHONE, True)):
        browser.open(page, size, phone)
        browser.run("window.dispatchEvent(new Event('beforeprint'))")
        for dark in (False, True):
            browser.size(*size, phone, dark)
            faults += [f"{size[0]} px{', dark' if dark else ''}: {fault}" for fault in page_faults(browser)]
        assert browser.complaints() == []
        assert len(browser.requests()) == calls
    assert not faults, "\n".join(faults)
    browser.open(page)
    links = browser.run("document.querySelectorAll('nav a').length")
    browser.press("Tab")
    if links:
        assert browser.run("document.activeElement.closest('nav') !== null"), "the first key leads to the sections"
        assert browser.run("getComputedStyle(document.activeElement).outlineStyle !== 'none'"), "focus is not seen"


def page_faults(browser: Browser) -> list[str]:
    """Faults of the open page as it is shown now: those of ``page_checks.js``, and serious findings of axe-core."""
    browser.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
    faults: list[str] = browser.run(CHECKS.read_text())
    wide = browser.run("document.documentElement.scrollWidth - document.documentElement.clientWidth")
    if wide > 0:
        wider = "[...document.body.querySelectorAll('*')].filter(n => n.scrollWidth > n.clientWidth + 1)"
        node = browser.run(f"({wider}.pop() || document.body).outerHTML.slice(0, 120)")
        faults.append(f"the page is {wide} px too wide: {node}")
    return faults + serious_findings(browser)


def serious_findings(browser: Browser) -> list[str]:
    """Serious and critical findings of axe-core on the open page, a sentence each; none where it is not installed."""
    script = axe_core()
    if script is None:
        return []
    if not browser.run("'axe' in window"):
        browser.run(script.read_text(encoding="utf-8") + "\n;true")
    found = browser.run("axe.run().then(result => JSON.stringify(result.violations))")
    return [
        f"{rule['id']} ({rule['impact']}): {rule['nodes'][0]['html'][:160]}"
        for rule in json.loads(found)
        if rule["impact"] in ("serious", "critical")
    ]


def axe_core() -> Path | None:
    """The script of axe-core; None where there is none."""
    named = os.environ.get(AXE)
    package = importlib.util.find_spec("axe_core_python")
    return Path(named) if named else package and next(Path(str(package.origin)).parent.rglob("axe.min.js"), None)


def chromium() -> str | None:
    """The path of a Chromium; None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@contextmanager
def opened(executable: str) -> Iterator[Browser]:
    """A headless Chromium with a profile of its own."""
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        one = Browser(executable, Path(profile))
        try:
            yield one
        finally:
            one.close()


@pytest.fixture(scope="session")
def browser():
    """A headless Chromium; the test skips where there is none."""
    executable = chromium()
    if executable is None:
        pytest.skip("no Chromium; `make system-packages` installs it")
    with opened(executable) as one:
        yield one
