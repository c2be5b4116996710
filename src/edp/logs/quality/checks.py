"""Checks of one channel, each a function from its statistics to findings; `CHECKS` lists them all."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edp.logs.quality.columns import columns
from edp.logs.quality.measures import Measures, Values, measure
from edp.logs.repair import runs
from edp.recording import Recording
from edp.signals import KINDS, UNITS, Channel, Kind
from edp.wording import typed

SEVERITIES = ("error", "warning", "note")
"""Severities of findings, the worst first."""
_STUCK_SECONDS = 1.0
"""Minimum reported duration of a constant value in a channel that may rest, s."""
_STUCK_SAMPLES = 50
_FROZEN_SECONDS = 0.5
"""Maximum constant time of a channel whose last digit always changes."""
_FROZEN_SAMPLES = 10
_CLIPPED_SAMPLES = 3
"""Minimum number of consecutive samples at an end of the range. Noise touches its extreme in single samples."""
_CLIPPED_SHARE = 1e-3
"""Minimum fraction of the time at that end."""
_NOISY_RATIO = 2.0
"""Ratio of standard deviation to noise floor below which a channel is mostly noise."""
_FEW_LEVELS = 64
"""Maximum number of levels of a coarse channel."""
_COARSE_STEP = 0.1
"""Fraction of the standard deviation above which a step is coarse."""
_MANY_SPIKES = 3
# A channel of these kinds whose largest value is below this part of the nominal size was hardly stored in SI.
_TOO_SMALL = {Kind.PRESSURE: 1e-4, Kind.PILOT_PRESSURE: 1e-4}
# Larger than any machine does, though within the hard limits.
_TOO_LARGE = {Kind.ANGLE: 4 * math.pi, Kind.ANGULAR_VELOCITY: 20.0}


@dataclass(frozen=True)
class Finding:
    """One thing worth knowing about a log.

    Attributes:
        severity: ``error`` (cannot be used as it is), ``warning`` (look at it) or ``note``.
        channel: the channel concerned, None for the whole log.
        what: description of the finding.
        count: number of affected samples, time stamps or segments.
        where: first place, as row and time.
        advice: recommended action.
    """

    severity: str
    channel: str | None
    what: str
    count: int = 0
    where: str = ""
    advice: str = ""


@dataclass(frozen=True, eq=False)
class Looked:
    """One channel as every check needs it.

    Attributes:
        channel: its name and kind.
        values: all samples, float32, shape ``(time,)``.
        good: the finite ones.
        rate_hz: samples per second.
        measures: see `edp.logs.quality.measures`; of the finite samples.
        stuck: starts of the runs of one value strictly between the ends of the range.
        stuck_lengths: their lengths in samples.
        in_gaps: missing samples that lie in gaps of time, which are a finding of their own.
    """

    channel: Channel
    values: Values
    good: Values
    rate_hz: float
    measures: Measures
    stuck: NDArray[np.intp]
    stuck_lengths: NDArray[np.intp]
    in_gaps: int = 0

    @property
    def samples(self) -> int:
        """Number of samples, including missing ones."""
        return len(self.values)

    @property
    def constant(self) -> bool:
        """Whether every good sample has one value."""
        return bool(len(self.good) and self.good.min() == self.good.max())

    @property
    def stuck_samples(self) -> int:
        """Length of the longest run of one value between the ends."""
        return int(self.stuck_lengths.max()) if len(self.stuck_lengths) else 0


Check = Callable[[Looked], list[Finding]]


def look_at(channel: Channel, values: Values, rate_hz: float, in_gaps: int = 0) -> Looked:
    """Collect the statistics of one channel that the checks need, float32, shape ``(time,)``."""
    finite = np.isfinite(values)
    good = values if finite.all() else values[finite]
    starts = lengths = np.empty(0, dtype=np.intp)
    if len(good) > 1 and good.min() != good.max():
        with np.errstate(invalid="ignore"):
            starts, stops = runs(np.diff(values) == 0)
        lengths = stops - starts + 1
        inside = (values[starts] != good.min()) & (values[starts] != good.max())
        starts, lengths = starts[inside], lengths[inside]
    return Looked(channel, values, good, rate_hz, measure(good), starts, lengths, in_gaps)


def place_of(row: int, rate_hz: float) -> str:
    """Return the row and time for messages."""
    return f"row {row} (t = {typed(row / rate_hz)} s)"


def shown(value: float, channel: Channel) -> str:
    """Return a value in the report unit followed by this unit; dimensionless values have no unit."""
    unit = KINDS[channel.kind].report_unit
    return typed(value) + ("" if unit == "1" else f" {unit}")


def copies(recording: Recording) -> list[Finding]:
    """Find channels that equal an earlier channel in every sample; constant channels do not count."""
    seen: dict[bytes, str] = {}
    findings = []
    for channel, values in zip(recording.channels, columns(recording), strict=True):
        # Constant channels equal each other without being copies.
        if len(values) < 2 or not np.nanmin(values, initial=np.inf) < np.nanmax(values, initial=-np.inf):
            continue
        first = seen.setdefault(hashlib.blake2b(values.data, digest_size=16).digest(), channel.name)
        if first != channel.name:
            advice = "one of them tells nothing new: leave it out"
            findings.append(Finding("note", channel.name, f"equals '{first}' in every sample", len(values), "", advice))
    return findings


def _check_missing(at: Looked) -> list[Finding]:
    bad = np.flatnonzero(~np.isfinite(at.values))
    if len(bad) <= at.in_gaps:
        return []
    infinite = int(np.isinf(at.values).sum())
    what = f"missing values (NaN), {infinite} of them infinite" if infinite else "missing values (NaN)"
    advice = "repair the file, or read with --repair nan=hold (gaps: gaps=hold or gaps=cut)"
    return [Finding("error", at.channel.name, what, len(bad) - at.in_gaps, place_of(int(bad[0]), at.rate_hz), advice)]


def _check_constant(at: Looked) -> list[Finding]:
    if len(at.good) < 2 or not at.constant:
        return []
    what = f"constant at {shown(KINDS[at.channel.kind].to_report(float(at.good[0])), at.channel)}"
    advice = "a dead sensor or an absent signal teaches nothing: check it, or map a constant"
    return [Finding("warning", at.channel.name, what, len(at.good), "", advice)]


def _check_range(at: Looked) -> list[Finding]:
    channel, values = at.channel, at.values
    if not len(at.good):
        return []
    facts = KINDS[channel.kind]
    largest = float(max(abs(at.good.min()), abs(at.good.max())))
    low, high = facts.plausible
    with np.errstate(invalid="ignore"):
        outside = np.flatnonzero((values < low) | (values > high))
    if len(outside):
        what = f"outside the plausible range {typed(low)} to {typed(high)} {facts.si_unit}"
        return [_unit_finding(channel, what, largest, len(outside), place_of(int(outside[0]), at.rate_hz))]
    if 0 < largest < _TOO_SMALL.get(channel.kind, 0.0) * facts.nominal and largest > 1.0:
        return [_unit_finding(channel, f"never above {typed(largest)} {facts.si_unit}", largest, len(at.good), "")]
    if largest > _TOO_LARGE.get(channel.kind, math.inf):
        row = int(np.nanargmax(np.abs(values)))
        return [
            _unit_finding(channel, f"reaches {typed(largest)} {facts.si_unit}", largest, 1, place_of(row, at.rate_hz))
        ]
    return []


def _unit_finding(channel: Channel, what: str, largest: float, count: int, where: str) -> Finding:
    guess = likely_unit(channel.kind, largest)
    hint = f"; looks like {guess}" if guess else ""
    advice = f'set unit = "{guess}" for this channel in the signal map' if guess else "check its unit and scale"
    return Finding("warning", channel.name, what + hint, count, where, advice)


def likely_unit(kind: Kind, largest: float) -> str | None:
    """Return the unit in which a largest value of `largest` is nearest to the nominal size of the kind."""
    facts = KINDS[kind]
    best, best_off = None, math.inf
    for name, unit in UNITS.items():
        value = largest * unit.factor + unit.offset
        if kind not in unit.kinds or name == facts.si_unit or not facts.plausible[0] <= value <= facts.plausible[1]:
            continue
        # The report unit is the likeliest: it is the field's usual one.
        # Decades from the nominal size: units differ by factors.
        off = abs(math.log10(max(value, 1e-30) / facts.nominal)) - (1.0 if name == facts.report_unit else 0.0)
        if off < best_off:
            best, best_off = name, off
    return best


def _check_stuck(at: Looked) -> list[Finding]:
    """Return the long runs of one value between the ends of the range.

    In a channel whose last digit moves all the time half a second means a frozen sensor or a stopped sender, also at
    zero. Other channels may rest at zero, and a command may be held: that is a note after a second. Between coarse
    steps a channel stays by nature.
    """
    if not len(at.stuck) or _coarseness(at) >= _COARSE_STEP:
        return []
    busy = at.measures.busy
    seconds, samples = (_FROZEN_SECONDS, _FROZEN_SAMPLES) if busy else (_STUCK_SECONDS, _STUCK_SAMPLES)
    long = np.flatnonzero(
        (at.stuck_lengths >= max(samples, seconds * at.rate_hz)) & ((at.values[at.stuck] != 0) | busy)
    )
    if not len(long):
        return []
    longest = long[np.argmax(at.stuck_lengths[long])]
    where = place_of(int(at.stuck[longest]), at.rate_hz)
    duration_text = f"longest {typed(at.stuck_lengths[longest] / at.rate_hz)} s"
    if busy:
        what, advice = (
            f"frozen: elsewhere each sample is new, {duration_text}",
            "leave these rows out (rows), or drop the channel",
        )
        return [Finding("warning", at.channel.name, what, len(long), where, advice)]
    advice = "a frozen sensor or a held command? check it"
    return [Finding("note", at.channel.name, f"stuck at one value, {duration_text}", len(long), where, advice)]


def _check_clipped(at: Looked) -> list[Finding]:
    """Return the noise that stops exactly at an end of the range: the sensor or the logger reaches no farther.

    Zero is passed over: a pilot pressure or a flow rests there.
    """
    measures = at.measures
    if not measures.busy or measures.end_run < _CLIPPED_SAMPLES:
        return []
    findings = []
    ends = (("lower", measures.at_low, at.good.min()), ("upper", measures.at_high, at.good.max()))
    for end, share, value in ends:
        if share < _CLIPPED_SHARE or value == 0:
            continue
        limit = shown(KINDS[at.channel.kind].to_report(float(value)), at.channel)
        what = f"clipped at its {end} end, {limit}, for {typed(100 * share, 2)} % of the time"
        advice = "the range of the sensor or the data type ends here: what lies beyond was not recorded"
        row = int(np.flatnonzero(at.values == value)[0])
        count = round(share * len(at.good))
        findings.append(Finding("warning", at.channel.name, what, count, place_of(row, at.rate_hz), advice))
    return findings


def _check_coarse(at: Looked) -> list[Finding]:
    """Report steps that are large compared with the variation of the channel, except for states and events."""
    step, levels, part = at.measures.quantum, at.measures.levels, _coarseness(at)
    if step is None or part < _COARSE_STEP:
        return []
    size = shown(KINDS[at.channel.kind].report_factor * step, at.channel)
    what = f"quantised in steps of {size}, {100 * part:.0f} % of its deviation ({levels} levels)"
    advice = "its differences are spikes of one step: log it finer, or derive nothing from it"
    return [Finding("warning", at.channel.name, what, levels, "", advice)]


def _coarseness(at: Looked) -> float:
    """Step over deviation of a quantised channel of more than three levels, else 0."""
    step, levels = at.measures.quantum, at.measures.levels
    if step is None or not 3 < levels <= _FEW_LEVELS:
        return 0.0
    return step / float(at.good.astype(np.float64).std())


def _check_noise(at: Looked) -> list[Finding]:
    noise = at.measures.noise
    if not at.measures.busy or noise <= 0:
        return []
    # Double precision: the deviation of float32 pressures loses digits in the sum.
    ratio = float(at.good.astype(np.float64).std()) / noise
    if ratio >= _NOISY_RATIO:
        return []
    what = f"mostly noise: its deviation is {typed(ratio, 2)} times its noise floor"
    return [Finding("note", at.channel.name, what, len(at.good), "", "it says little by the sample: check the sensor")]


def _check_rate(at: Looked) -> list[Finding]:
    every = at.measures.every
    if every < 1.5:
        return []
    what = f"a new value only every {typed(every, 3)} samples ({typed(at.rate_hz / every, 3)} Hz)"
    advice = "sent more slowly than logged: its age adds to the lag, and its differences are spikes"
    return [Finding("note", at.channel.name, what, len(at.good), "", advice)]


def _check_spikes(at: Looked) -> list[Finding]:
    if not at.measures.spikes:
        return []
    row = int(np.flatnonzero(np.isfinite(at.values))[at.measures.first_spike])
    advice = "a lost bit or a loose contact? set such samples to NaN and hold them, or leave these rows out"
    what = "single samples far off both neighbours"
    severity = "warning" if at.measures.spikes >= _MANY_SPIKES else "note"  # an impact may be one
    return [Finding(severity, at.channel.name, what, at.measures.spikes, place_of(row, at.rate_hz), advice)]


CHECKS: tuple[Check, ...] = (
    _check_missing,
    _check_constant,
    _check_range,
    _check_stuck,
    _check_clipped,
    _check_coarse,
    _check_noise,
    _check_rate,
    _check_spikes,
)
