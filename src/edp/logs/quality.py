"""What is odd in a recording: found and reported, never mended here."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.logs.repair import runs
from edp.recording import Recording
from edp.signals import KINDS, UNITS, Channel, Kind

_STUCK_SECONDS = 1.0
_STUCK_SAMPLES = 50
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
        what: what was found.
        count: how many samples, stamps or stretches.
        where: first place, as row and time.
        advice: what to do.
    """

    severity: str
    channel: str | None
    what: str
    count: int = 0
    where: str = ""
    advice: str = ""


@dataclass(frozen=True)
class ChannelFacts:
    """Facts of one channel in its report unit (``mm/s``, ``bar`` and so on); missing samples are left out."""

    name: str
    kind: str
    unit: str
    min: float
    max: float
    mean: float
    std: float
    missing: int
    constant: bool


@dataclass(frozen=True)
class QualityReport:
    """All findings of one log, worst first, with the facts of its time and channels."""

    name: str
    source: str
    samples: int
    rate_hz: float
    duration_s: float
    jitter: float
    channels: tuple[ChannelFacts, ...]
    findings: tuple[Finding, ...]

    @property
    def errors(self) -> tuple[Finding, ...]:
        """Findings that keep the log from being used as it is."""
        return tuple(finding for finding in self.findings if finding.severity == "error")

    def to_json(self) -> dict[str, Any]:
        """Plain JSON values; a number that is not finite becomes None."""
        return _plain(asdict(self))


Check = Callable[[Channel, NDArray[np.float32], float], list[Finding]]


def inspect(recording: Recording, extra: tuple[Finding, ...] = (), jitter: float = 0.0) -> QualityReport:
    """Check every channel of a recording.

    Args:
        recording: values float32, shape ``(time, channel)``, SI units; NaN marks missing values.
        extra: findings about the file made before (time stamps, columns).
        jitter: rms distance of the file's stamps from a uniform grid, in steps.
    """
    findings = list(extra)
    facts = []
    for place, channel in enumerate(recording.channels):
        values = recording.values[:, place]
        facts.append(_facts(channel, values))
        for check in (_check_missing, _check_constant, _check_range, _check_stuck):
            findings += check(channel, values, recording.rate_hz)
    order = {"error": 0, "warning": 1, "note": 2}
    return QualityReport(
        recording.name,
        recording.source,
        recording.samples,
        recording.rate_hz,
        recording.duration_s,
        jitter,
        tuple(facts),
        tuple(sorted(findings, key=lambda finding: order[finding.severity])),
    )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def place_of(row: int, rate_hz: float) -> str:
    """Row and time for messages."""
    return f"row {row} (t = {row / rate_hz:g} s)"


def _good(values: NDArray[np.float32]) -> NDArray[np.float64]:
    return values[np.isfinite(values)].astype(np.float64)


def _in_report_unit(channel: Channel, value: float) -> float:
    """SI to report unit, offset included (K to degC)."""
    facts = KINDS[channel.kind]
    unit = UNITS[facts.report_unit]
    return (value - unit.offset) / unit.factor


def _facts(channel: Channel, values: NDArray[np.float32]) -> ChannelFacts:
    good = _good(values)
    unit = KINDS[channel.kind].report_unit
    missing = len(values) - len(good)
    if not len(good):
        nan = float("nan")
        return ChannelFacts(channel.name, str(channel.kind), unit, nan, nan, nan, nan, missing, False)
    low, high, mean = (_in_report_unit(channel, float(x)) for x in (good.min(), good.max(), good.mean()))
    std = float(good.std()) / UNITS[unit].factor
    constant = bool(good.min() == good.max())
    return ChannelFacts(
        channel.name, str(channel.kind), unit, low, high, mean, 0.0 if constant else std, missing, constant
    )


def _check_missing(channel: Channel, values: NDArray[np.float32], rate_hz: float) -> list[Finding]:
    bad = np.flatnonzero(~np.isfinite(values))
    if not len(bad):
        return []
    infinite = int(np.isinf(values).sum())
    what = f"missing values (NaN), {infinite} of them infinite" if infinite else "missing values (NaN)"
    advice = 'mend the file, or read with repair nan = "hold" (gaps: "hold" or "cut")'
    return [Finding("error", channel.name, what, len(bad), place_of(int(bad[0]), rate_hz), advice)]


def _check_constant(channel: Channel, values: NDArray[np.float32], rate_hz: float) -> list[Finding]:
    good = _good(values)
    if len(good) < 2 or good.min() != good.max():
        return []
    unit = KINDS[channel.kind].report_unit
    what = f"constant at {_in_report_unit(channel, float(good[0])):g} {unit}"
    advice = "a dead sensor or an absent signal teaches nothing: check it, or map a constant"
    return [Finding("warning", channel.name, what, len(good), "", advice)]


def _check_range(channel: Channel, values: NDArray[np.float32], rate_hz: float) -> list[Finding]:
    good = _good(values)
    if not len(good):
        return []
    facts = KINDS[channel.kind]
    largest = float(np.abs(good).max())
    low, high = facts.plausible
    with np.errstate(invalid="ignore"):
        outside = np.flatnonzero((values < low) | (values > high))
    if len(outside):
        what = f"outside the plausible range {low:g} to {high:g} {facts.si_unit}"
        return [_unit_finding("warning", channel, what, largest, len(outside), place_of(int(outside[0]), rate_hz))]
    if 0 < largest < _TOO_SMALL.get(channel.kind, 0.0) * facts.nominal and largest > 1.0:
        what = f"never above {largest:g} {facts.si_unit}"
        return [_unit_finding("warning", channel, what, largest, len(good), "")]
    if largest > _TOO_LARGE.get(channel.kind, math.inf):
        what = f"reaches {largest:g} {facts.si_unit}"
        return [_unit_finding("warning", channel, what, largest, 1, place_of(int(np.argmax(np.abs(values))), rate_hz))]
    return []


def _unit_finding(severity: str, channel: Channel, what: str, largest: float, count: int, where: str) -> Finding:
    guess = _likely_unit(channel.kind, largest)
    hint = f"; looks like {guess}" if guess else ""
    advice = f'set unit = "{guess}" for this channel in the signal map' if guess else "check its unit and scale"
    return Finding(severity, channel.name, what + hint, count, where, advice)


def _likely_unit(kind: Kind, largest: float) -> str | None:
    """The unit in which a largest value of `largest` would be nearest to the kind's nominal size."""
    facts = KINDS[kind]
    best, best_off = None, math.inf
    for name, unit in UNITS.items():
        value = largest * unit.factor + unit.offset
        if kind not in unit.kinds or name == facts.si_unit or not facts.plausible[0] <= value <= facts.plausible[1]:
            continue
        # The report unit is the likeliest: it is the field's usual one.
        off = abs(math.log10(max(value, 1e-30) / facts.nominal)) - (1.0 if name == facts.report_unit else 0.0)
        if off < best_off:
            best, best_off = name, off
    return best


def _check_stuck(channel: Channel, values: NDArray[np.float32], rate_hz: float) -> list[Finding]:
    """Long runs of one value that is neither an end of the range nor zero (idle and saturation are ordinary)."""
    good = _good(values)
    if len(good) < 2 or good.min() == good.max():
        return []
    starts, stops = runs(np.diff(values) == 0)
    lengths = stops - starts + 1
    inside = (values[starts] != good.min()) & (values[starts] != good.max()) & (values[starts] != 0)
    long = np.flatnonzero(inside & (lengths >= max(_STUCK_SAMPLES, _STUCK_SECONDS * rate_hz)))
    if not len(long):
        return []
    longest = long[np.argmax(lengths[long])]
    what = f"stuck at one value, longest {lengths[longest] / rate_hz:g} s"
    where = place_of(int(starts[longest]), rate_hz)
    return [Finding("note", channel.name, what, len(long), where, "a frozen sensor or a held command? check it")]
