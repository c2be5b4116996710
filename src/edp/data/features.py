"""Feature sets: which channels a network reads, and channels derived from them tick by tick (eq. 3.1 to 3.3)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from edp.errors import ConfigError, DataError
from edp.recording import FloatArray, Recording
from edp.registry import Registry
from edp.settings.bounds import MAX_NAMES, MOST_TICKS, above, check_bounds, check_count, integer
from edp.signals import TABLE_A1, VOCABULARY, Kind
from edp.wording import setting_text, typed

STARTING = "starting"
"""The feature that tells a network whether channels of the start are read at this tick."""

MAX_SECONDS = 31_557_600.0  # a year; how many ticks a span may have is checked where the rate is known
ROUNDING = 1e-6
"""Ticks by which a span may miss a whole number of them."""
MAX_LAG = 4096
"""Longest span in ticks that a layer before a network looks back; a longer memory is the work of a recurrent layer."""
Gain = Callable[[int, float], float]
"""(ticks of the span, rate in Hz) to a factor."""


@dataclass(frozen=True)
class Derivation:
    """``gain mean(s[t], ..., s[t - n + 1])``, where s is the source or its change from tick to tick.

    The first tick after a reset is its own predecessor, so its change is 0; before n ticks have passed, the mean is
    that of those seen. All derivations are causal, and made of layers that every export has.

    Attributes:
        of_changes: whether s is the change ``x[t] - x[t - 1]``, and not x itself.
        gain: see `Gain`.
        least_ticks: minimum length of a span that is stated in seconds, in samples; 0 if the derivation has no span (n
            = 1).
    """

    of_changes: bool
    gain: Gain
    least_ticks: int = 0


DERIVATIONS: Registry[Derivation] = Registry("derivation")
DERIVATIONS.register("difference")(Derivation(of_changes=True, gain=lambda ticks, rate_hz: 1.0))
"""``x[t] - x[t - 1]`` (eq. 3.1), in the unit of the source."""
DERIVATIONS.register("derivative")(Derivation(of_changes=True, gain=lambda ticks, rate_hz: rate_hz))
"""Backward difference quotient ``(x[t] - x[t - 1]) rate``, in unit per second; never a central one."""
DERIVATIONS.register("change")(Derivation(of_changes=True, gain=lambda ticks, rate_hz: float(ticks), least_ticks=1))
"""``x[t] - x[t - n]``; in the first n ticks what it would be if the stream had gone on like this before."""
DERIVATIONS.register("trailing_mean")(Derivation(of_changes=False, gain=lambda ticks, rate_hz: 1.0, least_ticks=2))
"""Mean of the last n values, in the unit of the source."""


@dataclass(frozen=True)
class Derived:
    """A channel computed tick by tick from one source channel.

    Attributes:
        name: its own.
        source: the logged channel that it comes from.
        how: a registered derivation.
        kind: physical quantity.
        span_s: span that it looks back, for derivations that take one; rounded to ticks of the task's rate.
    """

    name: str
    source: str
    how: str = "difference"
    kind: Kind = Kind.GENERIC
    span_s: float | None = None

    def __post_init__(self) -> None:
        least = DERIVATIONS[self.how].least_ticks  # an unknown name fails here, with the closest one
        if least and self.span_s is None:
            raise ConfigError(
                f"derived '{self.name}': how = '{self.how}' looks back over a span; give it, for example span_s = 0.1"
            )
        if not least and self.span_s is not None:
            timed = [f"'{name}'" for name in DERIVATIONS if DERIVATIONS[name].least_ticks]
            raise ConfigError(
                f"derived '{self.name}': span_s = {setting_text(self.span_s)} came with how = '{self.how}', which "
                "has no span; "
                f"leave it out, or take {' or '.join(timed)}"
            )
        if self.span_s is not None:
            check_bounds(f"derived '{self.name}'", self, span_s=above(0.0, MAX_SECONDS))

    def ticks(self, rate_hz: float) -> int:
        """Return how many ticks it looks back at a rate, n of its derivation; 1 where it takes no span.

        Raises:
            ConfigError: a span shorter than the derivation allows, or longer than `MAX_LAG`.
        """
        if self.span_s is None:
            return 1
        exact, least = self.span_s * rate_hz, DERIVATIONS[self.how].least_ticks
        # A hair below, so that 0.03 s at 100 Hz, which floats make 2.9999 ticks, are 3.
        if exact < least - ROUNDING or round(exact) > MAX_LAG:
            raise ConfigError(
                f"derived '{self.name}': span_s = {setting_text(self.span_s)} are {typed(exact)} ticks at "
                f"{typed(rate_hz)} Hz; from "
                f"{least} to {MAX_LAG} ticks must hold for how = '{self.how}': choose from {typed(least / rate_hz)} "
                "to "
                f"{typed(MAX_LAG / rate_hz)} s"
            )
        return round(exact)

    def gain(self, rate_hz: float) -> float:
        """Return the factor of the mean at a sampling rate."""
        return DERIVATIONS[self.how].gain(self.ticks(rate_hz), rate_hz)


@dataclass(frozen=True)
class FeatureSet:
    """The columns of a network: logged channels, then derived ones.

    Attributes:
        name: name in reports.
        channels: logged channels, in order; these are the inputs of a bundle, in SI units.
        derived: channels computed inside the predictor, appended in order.
        hidden: logged channels that only serve as sources of derived ones; inputs, but not features.
        init_channels: logged channels that are read in the first ticks after a reset only, so that a free run starts
            from a measured state; with them comes the feature `STARTING`, 1 while they are read and 0 from then on.
        init_samples: number of samples for which the start-up channels are read.
    """

    name: str
    channels: tuple[str, ...]
    derived: tuple[Derived, ...] = ()
    hidden: tuple[str, ...] = ()
    init_channels: tuple[str, ...] = ()
    init_samples: int = 5

    def __post_init__(self) -> None:
        check_bounds(f"feature set '{self.name}'", self, init_samples=integer(1, MOST_TICKS))
        for part in ("channels", "derived", "hidden", "init_channels"):
            check_count(f"feature set '{self.name}'", part, getattr(self, part), MAX_NAMES)
        names = [*self.channels, *self.init_channels, *self.hidden, *(d.name for d in self.derived)]
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
        """Logged channels that are read at each sample, and `init_channels`, which count in the first samples only."""
        return self.channels + self.hidden + self.init_channels

    @property
    def features(self) -> tuple[str, ...]:
        """Features in network order: channels, derived channels, initialisation inputs."""
        return self.lasting + self.init_channels + ((STARTING,) if self.init_channels else ())

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
    """Return a derived channel over a whole segment, shape ``(time,)``, equal to the values of a stream after a reset.

    Raises:
        ConfigError: a span that does not go with the rate.
    """
    ticks, gain = entry.ticks(rate_hz), entry.gain(rate_hz)
    if DERIVATIONS[entry.how].of_changes:
        # The first tick is its own predecessor, as in a stream from reset.
        before = np.concatenate([source[:1], source[:-1]])
        values = (source - before) * np.float32(gain)
        return np.asarray(values if ticks == 1 else _trailing_mean(source - before, ticks) * gain, dtype=np.float32)
    return np.asarray(_trailing_mean(source, ticks) * gain, dtype=np.float32)


def _trailing_mean(values: FloatArray, ticks: int) -> np.ndarray:
    """Return the mean of the last `ticks` values, or of all values until now, ``(time,)`` in double precision."""
    # About the first value: sums of 30 MPa over hours would lose the digits in which the signal lies.
    first = float(values[0]) if len(values) else 0.0
    sums = np.concatenate([np.zeros(1), np.cumsum(values.astype(np.float64) - first)])
    count = np.arange(1, len(values) + 1)
    begin = np.maximum(count - ticks, 0)
    return np.asarray(first + (sums[count] - sums[begin]) / (count - begin))


def column(recording: Recording, name: str, derived: Sequence[Derived]) -> FloatArray:
    """Return a logged or derived channel of a recording by name, shape ``(time,)``.

    Raises:
        DataError: neither a channel of the recording nor a derived one.
    """
    for entry in derived:
        if entry.name == name:
            return derive(entry, recording.column(entry.source), recording.rate_hz)
    return recording.column(name)


def kind_of(name: str, recording: Recording | None, derived: Sequence[Derived]) -> Kind:
    """Return the kind of a logged or derived channel."""
    for entry in derived:
        if entry.name == name:
            return entry.kind
    if recording is not None:
        return recording.channels[recording.index(name)].kind
    if name in VOCABULARY:
        return VOCABULARY[name].kind
    raise DataError(f"the kind of channel '{name}' is not known; give it in the signal map")
