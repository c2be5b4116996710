"""Time and progress of the monitor's benchmark: lines for runs that are cut off, and work beside the run."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

from common import finite

BEGAN = time.monotonic()


def say(what: str, value: Any) -> None:
    """A line with what was found, for runs that are cut off."""
    print(json.dumps({"found": what, "after_s": round(time.monotonic() - BEGAN), "value": finite(value)}), flush=True)


class Beside:
    """Work in a thread beside the rest, whose result is asked for later; ends with the program."""

    def __init__(self, work: Callable[[], Any]) -> None:
        self._work, self._result = work, None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._result = self._work()
        except Exception as error:
            self._error = error

    def done(self) -> bool:
        """Whether it has come to its end."""
        return not self._thread.is_alive()

    def result(self) -> Any:
        """What came of it; waits for it.

        Raises:
            Exception: that of the work.
        """
        self._thread.join()
        if self._error is not None:
            raise self._error
        return self._result
