"""Timing of samples: real time multiplied by a speed, with pauses, controlled by viewers."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable

from edp.errors import ConfigError
from edp.wording import typed

SLOWEST, FASTEST = 0.01, 1000.0
"""Limits of the playback speed that a viewer may request, relative to real time."""
LATE_S = 1.0
"""Maximum delay of a source, s. With a larger delay the source skips the lost time instead of catching up."""

LATE_SHOWN_S = 10.0


class Pace:
    """The clock of a source that can be steered.

    Args:
        rate_hz: sampling rate in Hz.
        speed: factor on real time; infinite for as fast as possible.
        clock: seconds that never go back.

    Attributes:
        speed: factor on real time.
        paused: whether ticks wait.
        stopped: whether the session is over.
        late: number of times that the clock was reset because processing was too slow.
    """

    def __init__(self, rate_hz: float, speed: float = 1.0, clock: Callable[[], float] = time.monotonic) -> None:
        self.rate_hz, self.speed, self.paused, self.stopped, self.late = rate_hz, check_speed(speed), False, False, 0
        self._clock, self._changed = clock, threading.Condition()
        self._ahead = 0
        self._base: tuple[int, float] | None = None
        self._late_tick: int | None = None

    def is_late(self, tick: int) -> bool:
        """Return whether time was given up within the last `LATE_SHOWN_S` of the source's time before a tick."""
        return self._late_tick is not None and tick - self._late_tick < LATE_SHOWN_S * self.rate_hz

    def wait(self, tick: int) -> bool:
        """Wait until a tick is due; False once the session is over."""
        with self._changed:
            while not self.stopped:
                if tick < self._ahead or (math.isinf(self.speed) and not self.paused):
                    self._base = None
                    return True
                if self.paused:
                    self._base = None
                    self._changed.wait()
                    continue
                now = self._clock()
                first, began = self._base = self._base or (tick, now)
                left = began + (tick - first) / (self.rate_hz * self.speed) - now
                if left <= 0.0:
                    if left < -LATE_S:
                        self.late += 1
                        self._late_tick = tick
                        self._base = None
                    return True
                self._changed.wait(left)
            return False

    def is_due(self, tick: int) -> bool:
        """Return whether a tick would not have to wait: the source is behind, or runs as fast as it can."""
        with self._changed:
            if self.stopped or self.paused:
                return False
            if tick < self._ahead or math.isinf(self.speed):
                return True
            if self._base is None:
                return False
            first, began = self._base
            return began + (tick - first) / (self.rate_hz * self.speed) <= self._clock()

    def pause(self, paused: bool) -> None:
        """Pause or continue the samples."""
        with self._changed:
            self.paused, self._base = paused, None
            self._changed.notify_all()

    def set_speed(self, speed: float) -> None:
        """Change the factor on real time.

        Raises:
            ConfigError: it is none.
        """
        with self._changed:
            self.speed, self._base = check_speed(speed), None
            self._changed.notify_all()

    def run_ahead(self, tick: int) -> None:
        """Process all samples before this sample without delay, so that models have seen them."""
        with self._changed:
            self._ahead = tick
            self._changed.notify_all()

    def stop(self) -> None:
        """End the session."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()


def check_speed(speed: float) -> float:
    """Return a checked speed factor.

    Raises:
        ConfigError: it is none.
    """
    if math.isinf(speed) and speed > 0:
        return speed
    if not SLOWEST <= speed <= FASTEST:
        raise ConfigError(f"speed {typed(speed)}; from {typed(SLOWEST)} to {typed(FASTEST)} times real time, or inf")
    return speed
