"""Opens pages in headless Chromium, at the width of a phone or of a desk, and asks them questions.

Chromium is driven by its own protocol over two pipes, so that no further package is needed and no port is opened.
"""

from __future__ import annotations

import base64
import importlib.util
import itertools
import json
import os
import re
import select
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterable, Iterator
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
            env=os.environ | {"TMPDIR": str(folder)},
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


def check_page(browser: Browser, page: Path, kind: str, own: Iterable[str] = ()) -> None:
    """What every page of EDP keeps: small, whole, quiet, on a phone and at a desk, for eyes, keys and screen readers.

    Args:
        browser: an open browser.
        page: an HTML file.
        kind: what its title ends in, which says by which template it was made.
        own: names of an excavator's parts that the data on the page bring with them; the page has no others.
    """
    assert page.stat().st_size < PAGE_BYTES
    faults = []
    for size, phone in ((DESK, False), (PHONE, True)):
        browser.open(page, size, phone)
        browser.run("window.dispatchEvent(new Event('beforeprint'))")
        for dark in (False, True):
            browser.size(*size, phone, dark)
            found = page_faults(browser, "color-contrast" if dark else "")
            faults += [f"{size[0]} px{', dark' if dark else ''}: {fault}" for fault in found]
        assert browser.complaints() == []
        assert browser.requests() == []
    check_kind(browser, kind)
    words = visible_text(browser)
    faults += [f"more digits than are known, format it by edp.wording: {one}" for one in long_numbers(words)]
    faults += [f"a number without a unit has the unit 1: {one}" for one in words if re.search(r"\[1\]|\(1\)²", one)]
    if kind not in ABOUT_EXCAVATORS:
        faults += [f"a word of an excavator on a page for any machine: {one}" for one in excavator_words(words, own)]
    assert not faults, "\n".join(faults)
    browser.open(page)
    links = browser.run("document.querySelectorAll('nav a').length")
    browser.press("Tab")
    if links:
        assert browser.run("document.activeElement.closest('nav') !== null"), "the first key leads to the sections"
        assert browser.run("getComputedStyle(document.activeElement).outlineStyle !== 'none'"), "focus is not seen"


def check_kind(browser: Browser, kind: str) -> None:
    """Check by which template the open page was made; `tests/security/test_pages.py` holds that every one is opened."""
    assert browser.run("document.title").endswith(f": {kind}")


ABOUT_EXCAVATORS = ("side view", "closed loops")
"""Pages that are made for nothing but an excavator's front: they need its geometry."""
EXCAVATOR = re.compile(
    r"\b(soils?|digs?|digging|levers?|buckets?|booms?|sticks?|cylinders?|excavators?|excavation|joystick)\b", re.I
)
NUMBER = re.compile(r"(?<![\w.,:/−-])[+−-]?(\d[\d,]*)\.(\d+)(?![\w.:/])")
NOT_SHOWN_ROUNDED = "script, style, template, .settings, [data-exact], pre, code, textarea, input, option"
"""What keeps numbers as they were given: settings, commands and hashes."""


def visible_text(browser: Browser) -> list[str]:
    """Return the text of every element and drawing of the open page, closed sections included, settings left out."""
    return browser.run(
        f"""(() => {{
        const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), texts = [];
        while (walker.nextNode()) {{
            const node = walker.currentNode;
            if (!node.parentElement.closest({json.dumps(NOT_SHOWN_ROUNDED)})) texts.push(node.data);
        }}
        return texts.map(text => text.trim()).filter(Boolean);
        }})()"""
    )


def long_numbers(texts: Iterable[str]) -> list[str]:
    """Return the texts that hold a number with decimals and more than four significant digits."""
    found = []
    for text in texts:
        digits = ["".join(match.groups()).replace(",", "").lstrip("0") for match in NUMBER.finditer(text)]
        if any(len(one) > 4 for one in digits):
            found.append(text[:120])
    return found


def excavator_words(texts: Iterable[str], own: Iterable[str] = ()) -> list[str]:
    """Return the texts that speak of parts or work of an excavator, the data's own names left out."""
    names = re.compile("|".join(map(re.escape, own)) or r"(?!)")
    return [text[:120] for text in texts if EXCAVATOR.search(names.sub("", text))]


def page_faults(browser: Browser, rule: str = "") -> list[str]:
    """Faults of the open page as it is shown now: those of ``page_checks.js``, and serious findings of axe-core.

    Args:
        browser: with the page.
        rule: the only rule of axe-core that is looked at; empty for all.
    """
    browser.run("new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done(true))))")
    faults: list[str] = browser.run(CHECKS.read_text())
    wide = browser.run("document.documentElement.scrollWidth - document.documentElement.clientWidth")
    if wide > 0:
        wider = "[...document.body.querySelectorAll('*')].filter(n => n.scrollWidth > n.clientWidth + 1)"
        node = browser.run(f"({wider}.pop() || document.body).outerHTML.slice(0, 120)")
        faults.append(f"the page is {wide} px too wide: {node}")
    return faults + serious_findings(browser, rule)


def serious_findings(browser: Browser, rule: str = "") -> list[str]:
    """Return the serious and critical findings of axe-core on the open page, a sentence each."""
    if not browser.run("'axe' in window"):
        browser.run(axe_core().read_text(encoding="utf-8") + "\n;true")
    # Maps have thousands of equal cells, of which a few are enough.
    browser.run("document.querySelectorAll('g.scaled > :nth-child(n + 9)').forEach(node => node.remove())")
    options = json.dumps({"runOnly": [rule]} if rule else {})
    found = browser.run(f"axe.run({options}).then(result => JSON.stringify(result.violations))")
    return [
        f"{rule['id']} ({rule['impact']}): {rule['nodes'][0]['html'][:160]}"
        for rule in json.loads(found)
        if rule["impact"] in ("serious", "critical")
    ]


def axe_core() -> Path:
    """Return the path of the script of axe-core; skip the test where it is not installed."""
    if named := os.environ.get(AXE):
        return Path(named)
    package = importlib.util.find_spec("axe_core_python")
    if package is None:
        pytest.skip("the package axe-core-python is not installed: run `make setup`")
    return next(Path(str(package.origin)).parent.rglob("axe.min.js"))


def chromium() -> str | None:
    """The path of a Chromium; None where there is none."""
    return next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@contextmanager
def opened(executable: str) -> Iterator[Browser]:
    """A headless Chromium with a profile of its own."""
    # Chromium makes a socket in its profile, whose path has 107 bytes at most.
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True, dir="/tmp") as profile:
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
