"""Common base of controllers: registry, plant interface, and the command that is always safe."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from edp.control.geometry import AXES
from edp.control.guard import TRUSTED, GuardVerdict
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.plant import STROKES as STROKES
from edp.control.plant import VELOCITIES as VELOCITIES
from edp.control.plant import PlantInterface as PlantInterface
from edp.control.plant import interface_of as interface_of
from edp.control.reference import TipReference
from edp.errors import ConfigError, EdpError
from edp.registry import Registry
from edp.wording import typed

Array = NDArray[np.float64]
MAX_EVENTS = 1_000
"""Maximum number of logged events, which bounds the memory when a sensor flickers."""


@dataclass(frozen=True)
class ControlEvent:
    """Event in which a controller deviated from its regular output.

    Attributes:
        tick: first sample of the event.
        ticks: number of consecutive samples.
        text: description.
    """

    tick: int
    ticks: int
    text: str


def log_event(events: list[ControlEvent], tick: int, text: str) -> None:
    """Append an event. A continuing event is extended; only the first `MAX_EVENTS` are stored."""
    last = events[-1] if events else None
    if last is not None and last.text == text and last.tick + last.ticks == tick:
        events[-1] = ControlEvent(last.tick, last.ticks + 1, text)
    elif len(events) < MAX_EVENTS:
        events.append(ControlEvent(tick, 1, text))


class ControlFault(Exception):
    """Raised by a controller without a result at this sample, such as a failed solver.

    `Controller.step` gives the safe command.
    """


class Controller(ABC):
    """Controller that computes the levers for a reference, one sample at a time.

    A subclass implements `begin` and `levers`. `step` protects the loop: if a channel of `reads` is missing or not
    finite, or if `levers` raises `ControlFault` or returns values that are not finite, the levers return to neutral at
    the slew limit and an event is logged. The loop itself never raises an error. Levers are cut to the limits.

    A guard (`edp.control.guard`) can declare channels as missing, except the channels in `spared`. `fallback` then
    computes the levers instead of `levers`.

    Args:
        plant: controlled plant.
        limits: limits of the levers.
        reads: names of the measured channels without which it has no output.
        spared: channels without which the controller still works if a guard does not trust them.

    Attributes:
        events: events since `reset`, at most `MAX_EVENTS`.
        info: figures of the last tick, such as the iterations of a solver; numbers only.

    Raises:
        ConfigError: the plant does not measure a channel that is read.
    """

    def __init__(
        self, plant: PlantInterface, limits: LoopLimits, reads: tuple[str, ...], spared: Collection[str] = ()
    ) -> None:
        self.plant, self.limits, self.reads = plant, limits, reads
        self._spared = np.isin(reads, list(spared))
        self.events: list[ControlEvent] = []
        self.info: dict[str, float] = {}
        self._columns = plant.columns(reads)
        self._before = np.zeros(AXES)

    @abstractmethod
    def begin(self, measured: Array, reference: TipReference) -> None:
        """Prepare for a reference.

        Args:
            measured: the channels of `reads` at the start, finite.
            reference: reference to follow.
        """

    @abstractmethod
    def levers(self, measured: Array, tick: int) -> Array:
        """Return the levers of a tick, shape (3,), before limits.

        Args:
            measured: the channels of `reads`, finite; NaN where a spared one is not trusted.
            tick: row of the reference that belongs to now.

        Raises:
            ControlFault: there is no output.
        """

    def fallback(self, measured: Array, tick: int, reason: str) -> Array:
        """Return the levers of a tick at which a guard does not trust the controller's model.

        Arguments and shape of `levers`.

        Args:
            measured: the channels of `reads`, finite; NaN where a spared one is not trusted.
            tick: row of the reference that belongs to now.
            reason: reason of the guard, for the log.

        Raises:
            ControlFault: it has no output without its model.
        """
        raise ControlFault(f"it has no fallback where a guard asks for one{f' ({reason})' if reason else ''}")

    def check(self, measured: Array) -> None:  # noqa: B027
        """Raise an error before any loop if the controller cannot work; the default accepts everything.

        Args:
            measured: the channels of `reads` at a start, in steady state.

        Raises:
            ConfigError: it could not control this plant.
        """

    def missed(self, tick: int) -> None:
        """Update the memory at a sample with the safe command; called in place of `step`."""
        self.info = {}

    @property
    def before(self) -> Array:
        """Levers of the last tick, after limits, shape (3,)."""
        return self._before

    def reset(self, observation: Array, reference: TipReference) -> None:
        """Start a loop with all levers at neutral.

        Args:
            observation: SI values in the order of the plant's channels.
            reference: reference to follow, at the rate of the plant.

        Raises:
            ConfigError: another rate, or a channel that is missing at the start.
        """
        if reference.rate_hz != self.plant.rate_hz:
            raise ConfigError(
                f"the reference has {typed(reference.rate_hz)} Hz, {self.plant.source} {typed(self.plant.rate_hz)} "
                "Hz; give both "
                "the same rate"
            )
        measured = np.asarray(observation, float)[self._columns]
        if not np.isfinite(measured).all():
            name = self.reads[int(np.argmin(np.isfinite(measured)))]
            raise ConfigError(
                f"'{name}' is missing at the start of the loop; start where all of {self.reads} are measured"
            )
        self.events, self.info = [], {}
        self._before = np.zeros(AXES)
        self.begin(measured, reference)

    def step(self, observation: Array, tick: int, verdict: GuardVerdict = TRUSTED) -> Array:
        """Return the levers to apply from now to the next tick, shape (3,), within the limits; never raises.

        Args:
            observation: SI values in the order of the plant's channels; NaN where one is missing.
            tick: row of the reference that belongs to now.
            verdict: verdict of a guard on this sample.
        """
        asked, fault = self._compute_levers(observation, tick, verdict)
        if fault:
            self._log(tick, fault)
            self.missed(tick)
        self._before = self.limits.applied(asked, self._before, self.plant.rate_hz)
        return self._before.copy()

    def late(self, before: Array, tick: int, reason: str) -> Array:
        """Return levers moved towards neutral if the levers of `step` came too late; an event is logged.

        Args:
            before: levers of the tick before, shape (3,).
            tick: row of the reference that belongs to now.
            reason: reason for the log.
        """
        self._log(tick, f"{reason}: spools to neutral")
        self.missed(tick)
        self._before = self.limits.applied(np.zeros(AXES), before, self.plant.rate_hz)
        return self._before.copy()

    def _compute_levers(self, observation: Array, tick: int, verdict: GuardVerdict) -> tuple[Array, str]:
        """Return the levers before limits, and the fault for which they are neutral; empty without one."""
        values = np.asarray(observation, float)
        neutral = np.zeros(AXES)
        if values.shape != (len(self.plant.channels),):
            return neutral, f"an observation of shape {values.shape} came for {len(self.plant.channels)} channels"
        measured = values[self._columns]
        lacking = ~np.isfinite(measured)
        if verdict.untrusted:
            doubted = np.isin(self.reads, list(verdict.untrusted))
            needed = doubted & ~self._spared
            if needed.any():
                return neutral, f"{self.reads[int(np.argmax(needed))]} is not trusted: spools to neutral"
            # A spared channel that a guard does not trust may be missing, too.
            measured[doubted], lacking = np.nan, lacking & ~doubted
        if lacking.any():
            return neutral, f"{self.reads[int(np.argmax(lacking))]} is missing: spools to neutral"
        try:
            if verdict.fall_back:
                levers = np.asarray(self.fallback(measured, tick, verdict.reason), float)
            else:
                levers = np.asarray(self.levers(measured, tick), float)
        except (ControlFault, EdpError, ArithmeticError, np.linalg.LinAlgError) as error:
            return neutral, f"no answer ({error}): spools to neutral"
        if levers.shape != (AXES,) or not np.isfinite(levers).all():
            return neutral, "the levers are not finite: spools to neutral"
        return levers, ""

    def _log(self, tick: int, text: str) -> None:
        """See `log_event`."""
        log_event(self.events, tick, text)


class ControllerSpec(Protocol):
    """Options of a controller: a frozen dataclass with bounds."""

    needs: ClassVar[tuple[str, ...]]
    """Attributes of `ControlModels` that the controller requires."""
    space: ClassVar[Mapping[str, tuple[float, float]]]
    """Search range of each option for tuning: lowest and highest value."""

    def build(self, plant: PlantInterface, limits: LoopLimits, models: ControlModels) -> Controller:
        """Build the controller for a plant.

        Raises:
            ConfigError: the plant or the models lack what it needs, or the limits contradict it.
        """
        ...


def list_unused_models(needs: Sequence[str], available: Collection[str]) -> list[str]:
    """Return the available models that a controller does not use.

    Args:
        needs: see `ControllerSpec`; of ``a or b`` the first that is available is used.
        available: names of models.
    """
    used = {next((name for name in need.split(" or ") if name in available), "") for need in needs}
    return sorted(set(available) - used)


CONTROLLERS: Registry[type] = Registry("controller")
"""Registry of the controller settings by name. Each controller has a file and a registration."""
