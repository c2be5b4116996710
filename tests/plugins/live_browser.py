"""A headless Chromium for tests and benchmarks of pages, driven through its debugging protocol."""

from __future__ import annotations

import base64
import contextlib
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
START_S = 60.0


class Page:
    """One tab.

    Attributes:
        messages: what it wrote to its console, and its errors.
    """

    def __init__(self, address: str) -> None:
        self._stack = contextlib.ExitStack()
        self._socket = self._stack.enter_context(connect(address, max_size=None, ping_interval=None))
        self._numbers = itertools.count(1)
        self.messages: list[str] = []
        self.requests: list[str] = []
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **options: Any) -> dict[str, Any]:
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": options}))
        while True:
            message = json.loads(self._socket.recv(timeout=60.0))
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                return message["result"]
            self._take(message)

    def _take(self, message: dict[str, Any]) -> None:
        method, facts = message.get("method"), message.get("params", {})
        if method == "Runtime.exceptionThrown":
            self.messages.append(str(facts["exceptionDetails"].get("exception", facts["exceptionDetails"])))
        elif method == "Log.entryAdded":
            self.messages.append(facts["entry"]["text"])
        elif method == "Runtime.consoleAPICalled":
            self.messages.append(" ".join(str(one.get("value")) for one in facts["args"]))
        elif method == "Network.requestWillBeSent":
            self.requests.append(facts["request"]["url"])

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)

    def value(self, expression: str) -> Any:
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(f"{expression}: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def wait(self, expression: str, seconds: float = 40.0) -> Any:
        ends = time.monotonic() + seconds
        while time.monotonic() < ends:
            value = self.value(expression)
            if value:
                return value
            time.sleep(0.1)
        raise AssertionError(f"never true: {expression}; the page says {self.messages[-5:]}")

    def size(self, width: int, height: int, dark: bool = False) -> None:
        options = {"deviceScaleFactor": 1, "mobile": width < 600}
        self.call("Emulation.setDeviceMetricsOverride", width=width, height=height, **options)
        scheme = "dark" if dark else "light"
        self.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": scheme}])

    def picture(self, path: Path) -> None:
        data = self.call("Page.captureScreenshot", format="png", captureBeyondViewport=False)["data"]
        path.write_bytes(base64.b64decode(data))

    def close(self) -> None:
        self._stack.close()


class Browser:
    """A process with tabs."""

    def __init__(self, port: int, pid: int) -> None:
        self.port, self.pid = port, pid

    def page(self) -> Page:
        order = urllib.request.Request(f"http://127.0.0.1:{self.port}/json/new?about:blank", method="PUT")
        with urllib.request.urlopen(order, timeout=30) as answer:
            return Page(json.load(answer)["webSocketDebuggerUrl"])


@contextlib.contextmanager
def browser() -> Iterator[Browser]:
    """Chromium without a display, drawing by software."""
    assert CHROMIUM is not None
    with tempfile.TemporaryDirectory() as profile:
        # Root, as in a container, has no sandbox of its own.
        rights = ["--no-sandbox"] if os.geteuid() == 0 else []
        options = ["--headless=new", "--disable-gpu", "--remote-debugging-port=0", "--no-first-run", "--mute-audio"]
        options += ["--disable-background-networking", "--disable-dev-shm-usage", f"--user-data-dir={profile}", *rights]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        process = subprocess.Popen([CHROMIUM, *options, "about:blank"], **quiet)
        try:
            port, ends = Path(profile) / "DevToolsActivePort", time.monotonic() + START_S
            while not (port.exists() and port.read_text().strip()):
                assert time.monotonic() < ends, "Chromium does not start"
                time.sleep(0.1)
            yield Browser(int(port.read_text().splitlines()[0]), process.pid)
        finally:
            process.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(20)
            time.sleep(0.3)  # its children still write into the profile
