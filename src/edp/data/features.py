"""Feature sets: which channels a network reads, and channels derived from them tick by tick (eq. 3.1 to 3.3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from edp.errors import ConfigError, DataError
from edp.recording import FloatArray, Recording
from edp.registry import Registry
from edp.settings.bounds import MOST_NAMES, MOST_TICKS, check_bounds, check_count, whole
from edp.signals import TABLE_A1, VOCABULARY, Kind

STARTING = "starting"
"""The feature that tells a network whether channels of the start are read at this tick."""

Derivation = Callable[[Any, Any, float], Any]
"""(value now, value one tick before, rate in Hz) to the derived value; the same code serves arrays and tensors."""

DERIVATIONS: Registry[Derivation] = Registry("derivation")


@DERIVATIONS.register("difference")
def difference(now: Any, before: Any, rate_hz: float) -> Any:
    """``x[t] - x[t-1]`` (eq. 3.1), in the unit of the source."""
    return now - before


@DERIVATIONS.register("derivative")
def derivative(now: Any, before: Any, rate_hz: float) -> Any:
    """Backward difference quotient ``(x[t] - x[t-1]) rate``, in unit per second; never a central one."""
    return (now - before) * rate_hz


@dataclass(frozen=True)
class Derived:
    """A channel computed from one source channel, now and one tick before; its value at the first tick is 0."""

    name: str
    source: str
    how: str = "difference"
    kind: Kind = Kind.GENERIC

    def __post_init__(self) -> None:
        _ = DERIVATIONS[self.how]  # an unknown name fails here, with the closest one


@dataclass(frozen=True)
class FeatureSet:
    """The columns of a network: logged channels, then derived ones.

    Attributes:
        name: how reports call it.
        channels: logged channels, in order; these are the inputs of a bundle, in SI units.
        derived: channels computed inside the predictor, appended in order.
        hidden: logged channels that only serve as sources of derived ones; inputs, but not features.
        starting: logged channels that are read in the first ticks after a reset only, so that a free run starts from
            a measured state; with them comes the feature `STARTING`, 1 while they are read and 0 from then on.
        starting_ticks: how many ticks they are read.
    """

    name: str
    channels: tuple[str, ...]
    derived: tuple[Derived, ...] = ()
    hidden: tuple[str, ...] = ()
    starting: tuple[str, ...] = ()
    starting_ticks: int = 5

    def __post_init__(self) -> None:
        check_bounds(f"feature set '{self.name}'", self, starting_ticks=whole(1, MOST_TICKS))
        for part in ("channels", "derived", "hidden", "starting"):
            check_count(f"feature set '{self.name}'", part, getattr(self, part), MOST_NAMES)
        names = [*self.channels, *self.starting, *self.hidden, *(d.name for d in self.derived)]
        twice = sorted(name for name, count in Counter(names).items() if count > 1)
        if twice:
            raise ConfigError(f"feature set '{self.name}' names {', '.join(twice)} twice; keep one entry each")
        if not self.channels and not self.derived:
            raise ConfigError(f"feature set '{self.name}' is empty; give it at least one channel")
        for entry in self.derived:
            if entry.source not in self.channels + self.hidden:
                raise ConfigError(
                    f"feature set '{self.name}': derived '{entry.name}' reads '{entry.source}', which is not an input "
                    "at every tick; add it to channels, or to hidden if the network should not see it"
                )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Logged channels that are fed at each tick; those of `starting` count in the first ticks only."""
        return self.channels + self.hidden + self.starting

    @property
    def features(self) -> tuple[str, ...]:
        """What the network sees: channels, derived ones, then those of the start."""
        return self.lasting + self.starting + ((STARTING,) if self.starting else ())

    @property
    def lasting(self) -> tuple[str, ...]:
        """Features that are known at every tick."""
        return self.channels + tuple(entry.name for entry in self.derived)


_PRESSURES = tuple(name for name in TABLE_A1 if name.startswith("CylPressures"))
FG1 = FeatureSet("FG1", tuple(TABLE_A1))
FG2 = FeatureSet(
    "FG2",
    tuple(TABLE_A1),
    tuple(Derived(f"d{name}", name, "difference", Kind.PRESSURE) for name in _PRESSURES),
)
FEATURE_SETS: Mapping[str, FeatureSet] = {"FG1": FG1, "FG2": FG2}


def derive(entry: Derived, source: FloatArray, rate_hz: float) -> FloatArray:
    """A derived channel over a whole stretch, shape ``(time,)``; the first tick is 0."""
    # The first tick is its own predecessor, as in a stream from reset.
    before = np.concatenate([source[:1], source[:-1]])
    return np.asarray(DERIVATIONS[entry.how](source, before, rate_hz), dtype=np.float32)


def column(recording: Recording, name: str, derived: Sequence[Derived]) -> FloatArray:
    """A logged or derived channel of a recording by name, shape ``(time,)``.

    Raises:
        DataError: neither a channel of the recording nor a derived one.
    """
    for entry in derived:
        if entry.name == name:
            return derive(entry, recording.column(entry.source), recording.rate_hz)
    return recording.column(name)


def kind_of(name: str, recording: Recording | None, derived: Sequence[Derived]) -> Kind:
    """Kind of a logged or derived channel."""
    for entry in derived:
        if entry.name == name:
            return entry.kind
    if recording is not None:
        return recording.channels[recording.index(name)].kind
    if name in VOCABULARY:
        return VOCABULARY[name].kind
    raise DataError(f"the kind of channel '{name}' is not known; give it in the signal map")
