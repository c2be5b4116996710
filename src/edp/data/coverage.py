"""Coverage of a data set: spectrum of the inputs, poses, joint histograms, events, distance of test from training data.

It works on any recordings: roles come from names or kinds (`edp.data.roles`), and what a recording lacks is named in
`Coverage.absent`, never guessed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.data import events, spectrum
from edp.data.distance import Distance, split_distance
from edp.data.integrals import contradiction, integral_fit
from edp.data.roles import Axis, Roles, roles_of, signed
from edp.data.splits import Split
from edp.data.twin_channels import INTEGRAL
from edp.errors import DataError
from edp.recording import STRETCH_S, Recording, spread_recordings
from edp.settings.results import json_value
from edp.signals import KINDS, Kind
from edp.wording import typed

Array = NDArray[np.float64]
CELLS = 6
"""Number of cells per stroke in the occupancy."""
BINS = 24
"""Number of bins per axis of a joint histogram."""
TAIL = 5e-4
"""Fraction of the samples at either end that a joint histogram omits."""
QUANTILES = 32
"""Number of bins with equal content for the mutual information."""
INFORMED = 200_000
"""Maximum number of samples for the mutual information, evenly spaced."""
MEASURED, INTEGRATED = "strokes", "integrated velocity"


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Inputs in the frequency domain; see `edp.data.spectrum`.

    Attributes:
        names: names of the commands; two one-sided commands count as their difference.
        frequency_hz: shape ``(frequency,)``.
        density: power spectral density, shape ``(frequency, command)``.
        flat_to_hz: frequency up to which each spectrum stays within 10 dB of its maximum.
        drop_db: attenuation of each spectrum at `used_hz` below its maximum.
        used_hz: frequency up to which spectra should be flat.
    """

    names: tuple[str, ...]
    frequency_hz: Array
    density: Array
    flat_to_hz: tuple[float, ...]
    drop_db: tuple[float, ...]
    used_hz: float


@dataclass(frozen=True, eq=False)
class Occupancy:
    """Time in each cell of up to three strokes.

    Attributes:
        source: ``strokes``, or ``integrated velocity`` where no stroke is measured.
        names: channels, an axis of `samples` each.
        span: lowest and highest value of each, m.
        full_stroke: whether the span is the cylinder's stroke; otherwise it is the recorded range.
        samples: count of samples, shape ``(CELLS,) * axes``.
    """

    source: str
    names: tuple[str, ...]
    span: tuple[tuple[float, float], ...]
    full_stroke: bool
    samples: NDArray[np.int64]

    @property
    def share(self) -> float:
        """Share of the cells that were visited."""
        return float((self.samples > 0).mean())


@dataclass(frozen=True, eq=False)
class JointHistogram:
    """Joint histogram of two signals in report units: `counts` has shape ``(x bin, y bin)``.

    Attributes:
        filled: fraction of the bins with a sample.
        correlation: Pearson's, over all samples.
        information: mutual information in nat between quantile bins at the same instant, bias of chance removed.
    """

    group: str
    x: str
    y: str
    x_unit: str
    y_unit: str
    x_range: tuple[float, float]
    y_range: tuple[float, float]
    counts: NDArray[np.int64]
    filled: float
    correlation: float
    information: float


@dataclass(frozen=True, eq=False)
class Coverage:
    """Coverage of a data set.

    Attributes:
        recordings, hours, rate_hz: its size.
        inputs: channels that command.
        singular: smallest singular value of the input Hankel matrix by lags; inputs of deviation 1.
        constant: inputs that never change, left out of `singular`.
        absent: figures that could not be computed, each with the reason.
        contradictions: strokes that are not integrals of their velocities, and the suggested action.
    """

    recordings: int
    hours: float
    rate_hz: float
    inputs: tuple[str, ...]
    singular: dict[int, float]
    constant: tuple[str, ...]
    spectrum: Spectrum | None
    occupancy: Occupancy | None
    joints: tuple[JointHistogram, ...]
    activity: tuple[events.Activity, ...]
    together: dict[str, float]
    events: tuple[events.RareEvent, ...]
    distance: Distance | None
    absent: tuple[str, ...] = field(default=())
    contradictions: tuple[str, ...] = field(default=())

    def to_json(self) -> dict[str, object]:
        """Convert to JSON types; arrays become lists, the occupancy gets its fraction of visited cells."""
        plain = json_value(self)
        if self.occupancy is not None:
            plain["occupancy"]["share"] = self.occupancy.share
        return dict(plain)


def cover(
    recordings: Sequence[Recording], inputs: Sequence[str] = (), split: Split | None = None, dead_band: float = 0.14
) -> Coverage:
    """Compute the coverage of a data set.

    Args:
        recordings: recordings with one sample rate and equal channels.
        inputs: command channels, required if neither name nor kind identifies them.
        split: whether to also compute the distance between its test data and its training data.
        dead_band: fraction of the largest command up to which an axis does not move.

    Raises:
        DataError: no recordings, mixed rates, an unknown input, or neither a command nor a velocity.
    """
    if not recordings:
        raise DataError("there are no recordings to look at; give a log or a folder of logs")
    first = recordings[0]
    # A thousandth allows for rates that two loggers state with different digits.
    if any(abs(r.rate_hz - first.rate_hz) > 1e-3 * first.rate_hz for r in recordings):
        raise DataError("coverage needs recordings of one rate; set rate_hz in the signal map")
    roles = roles_of(first, inputs)
    if not roles.axes:
        raise DataError(
            f"recording '{first.name}' has neither a velocity nor a command (pilot pressure, current, voltage, ratio); "
            "map channels with their kinds, or name the inputs"
        )
    absent: list[str] = []
    whole, hours = recordings, sum(r.samples for r in recordings) / first.rate_hz / 3600.0
    recordings = spread_recordings(whole, STRETCH_S)
    if sum(r.samples for r in recordings) < sum(r.samples for r in whole):
        shown = sum(r.samples for r in recordings) / first.rate_hz / 3600.0
        absent.append(
            f"all but {len(recordings):,} evenly spread stretches of {typed(STRETCH_S)} s: counts, shares and "
            "histograms "
            f"are of these {shown:.1f} h of {hours:,.1f} h"
        )
    moving, constant = _inputs(recordings, roles)
    axes = _select_axes(first, roles, absent)
    occupancy = _occupancy(recordings, roles.axes, absent)
    if not roles.inputs:
        absent.append("excitation: no channel is known to command; name the inputs")
    return Coverage(
        len(whole),
        hours,
        first.rate_hz,
        roles.inputs,
        spectrum.smallest_singular_values([r.select(moving).astype(np.float64) for r in recordings]) if moving else {},
        constant,
        _spectrum(recordings, roles),
        occupancy,
        tuple(_joints(recordings, axes, absent)) if axes else (),
        events.activity_of(recordings, axes, dead_band),
        events.together(recordings, axes, dead_band),
        events.events_of(recordings, None if occupancy is None or not occupancy.full_stroke else _ends(occupancy)),
        None if split is None else split_distance(whole, roles.axes, split),
        tuple(absent),
        tuple(_contradictions(recordings, roles.axes)),
    )


def _select_axes(first: Recording, roles: Roles, absent: list[str]) -> tuple[Axis, ...]:
    """Return the axes whose velocity has a known kind; names of the other axes are added to `absent`."""
    kinds = {channel.name: channel.kind for channel in first.channels}
    unknown = [axis.velocity for axis in roles.axes if kinds.get(axis.velocity) is Kind.GENERIC]
    if not unknown:
        return roles.axes
    named = ", ".join(unknown[:3]) + (", ..." if len(unknown) > 3 else "")
    absent.append(
        f"reversals, time active and joint histograms: {named} are numbers of no kind (generic); give those that move "
        "a kind in the signal map (velocity, position, pressure, ...)"
    )
    return tuple(axis for axis in roles.axes if axis.velocity not in unknown)


def _contradictions(recordings: Sequence[Recording], axes: Sequence[Axis]) -> Iterator[str]:
    """Yield a message for each axis whose stroke is not the integral of its velocity."""
    kinds = {channel.name: channel.kind for channel in recordings[0].channels}
    for axis in axes:
        # What answers where no velocity is recorded may be anything.
        if axis.stroke and INTEGRAL.get(kinds.get(axis.velocity, Kind.GENERIC)) is kinds[axis.stroke]:
            pairs = [(r.column(axis.velocity), r.column(axis.stroke)) for r in recordings]
            fit = integral_fit(pairs, recordings[0].rate_hz)
            if fit.contradicts:
                yield contradiction(axis.velocity, axis.stroke, fit)


def _inputs(recordings: Sequence[Recording], roles: Roles) -> tuple[list[str], tuple[str, ...]]:
    """Return the inputs that change, and the inputs that are constant."""

    def changes(name: str) -> bool:
        values = [r.column(name) for r in recordings]
        return float(max(v.max() for v in values) - min(v.min() for v in values)) > 0.0

    moving = [name for name in roles.inputs if changes(name)]
    return moving, tuple(name for name in roles.inputs if name not in moving)


def _spectrum(recordings: Sequence[Recording], roles: Roles) -> Spectrum | None:
    sources = dict.fromkeys(axis.command for axis in roles.axes if axis.command)
    if not sources:
        return None
    stretches = [np.stack([signed(r, command) for command in sources], axis=1) for r in recordings]
    frequency, power = spectrum.density(stretches, recordings[0].rate_hz)
    used = spectrum.used_hz(recordings[0].rate_hz)
    flat, drop = zip(*(spectrum.flat_to(frequency, power[:, i], used) for i in range(len(sources))))
    # a tenth of an octave is enough for a picture
    plotted_frequencies = np.geomspace(frequency[0], frequency[-1], 90) if len(frequency) else np.zeros(0)
    bins = np.unique(np.minimum(np.searchsorted(frequency, plotted_frequencies), max(len(frequency) - 1, 0)))
    names = tuple(" - ".join(command) for command in sources)
    return Spectrum(names, frequency[bins], power[bins], flat, drop, used)


def _occupancy(recordings: Sequence[Recording], axes: Sequence[Axis], absent: list[str]) -> Occupancy | None:
    """Compute the occupancy of the strokes of up to three axes, from measured strokes or integrated velocities."""
    stroked = [axis for axis in axes if axis.stroke][:3]
    if stroked:
        names, source = tuple(axis.stroke for axis in stroked), MEASURED
        places = np.concatenate([r.select(names) for r in recordings])
    else:
        moves = {c.name for c in recordings[0].channels if c.kind in (Kind.VELOCITY, Kind.ANGULAR_VELOCITY)}
        names = tuple(axis.velocity for axis in axes if axis.velocity in moves)[:3]
        source = INTEGRATED
        if not names:
            absent.append("occupancy: neither strokes nor velocities")
            return None
        absent.append(
            "strokes are not recorded: the occupancy integrates velocities, each recording about its own mean, so that "
            "offsets between recordings and drift are in it"
        )
        places = np.concatenate([_integrate(r, names) for r in recordings])
    full: Any = recordings[0].meta.get("full_strokes_m") if source == MEASURED else None
    has_ranges = isinstance(full, list | tuple) and len(full) == len(names)
    if has_ranges:
        span = tuple((0.0, float(length)) for length in full)
    else:
        span = tuple((float(low), float(high)) for low, high in zip(places.min(axis=0), places.max(axis=0)))
    cells = [_cell(places[:, i], *span[i], CELLS) for i in range(len(names))]
    samples = _count_cells(cells, (CELLS,) * len(names))
    return Occupancy(source, names, span, has_ranges, samples)


def _ends(occupancy: Occupancy) -> dict[str, tuple[float, float]]:
    return dict(zip(occupancy.names, occupancy.span, strict=True))


def _integrate(recording: Recording, names: Sequence[str]) -> Array:
    way = np.cumsum(recording.select(names).astype(np.float64), axis=0) / recording.rate_hz
    # An integral has no absolute position; its mean represents mid stroke.
    return np.asarray(way - way.mean(axis=0))


def _cell(values: NDArray[Any], low: float, high: float, count: int) -> NDArray[np.intp]:
    # A constant channel is in the first cell; this avoids a division by zero.
    share = (np.asarray(values, dtype=np.float64) - low) / max(high - low, 1e-12)
    return np.clip(np.floor(share * count), 0, count - 1).astype(np.intp)


def _count_cells(cells: Sequence[NDArray[np.intp]], shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return how often each cell occurs; one array of places an axis."""
    flat = np.ravel_multi_index(tuple(cells), shape)
    return np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape)


def _joints(recordings: Sequence[Recording], axes: Sequence[Axis], absent: list[str]) -> list[JointHistogram]:
    """Return the histograms of command, pressures and velocity of each axis, and of velocities with each other."""
    joints = [_joint(recordings, "command", a.command, (a.velocity,)) for a in axes if a.command and a.velocity]
    for side, title in enumerate(("head pressure", "rod pressure")):
        chosen = [axis for axis in axes if len(axis.pressures) > side and axis.velocity]
        joints += [_joint(recordings, title, (axis.pressures[side],), (axis.velocity,)) for axis in chosen]
    speeds = [axis.velocity for axis in axes if axis.velocity]
    pairs = [(a, b) for i, a in enumerate(speeds) for b in speeds[i + 1 :]]
    joints += [_joint(recordings, "velocities", (a,), (b,)) for a, b in pairs]
    for title in ("command", "head pressure", "velocities"):
        if not any(joint.group == title for joint in joints):
            absent.append(f"joint histograms of {title}: no such channels")
    return joints


def _joint(recordings: Sequence[Recording], group: str, x: tuple[str, ...], y: tuple[str, ...]) -> JointHistogram:
    (x_values, x_unit), (y_values, y_unit) = _values(recordings, x), _values(recordings, y)
    (x_low, x_high), (y_low, y_high) = _range(x_values), _range(y_values)
    inside = (x_values >= x_low) & (x_values <= x_high) & (y_values >= y_low) & (y_values <= y_high)
    cells = [_cell(x_values[inside], x_low, x_high, BINS), _cell(y_values[inside], y_low, y_high, BINS)]
    counts = _count_cells(cells, (BINS, BINS))
    with np.errstate(invalid="ignore"):
        alike = x_values.std() > 0 and y_values.std() > 0
        correlation = float(np.corrcoef(x_values, y_values)[0, 1]) if alike else 0.0
    return JointHistogram(
        group,
        " - ".join(x),
        " - ".join(y),
        x_unit,
        y_unit,
        (x_low, x_high),
        (y_low, y_high),
        counts,
        float((counts > 0).mean()),
        correlation,
        mutual_information(x_values, y_values),
    )


def _values(recordings: Sequence[Recording], names: tuple[str, ...]) -> tuple[Array, str]:
    kind = recordings[0].channels[recordings[0].index(names[0])].kind
    facts, values = KINDS[kind], np.concatenate([signed(r, names) for r in recordings])
    # Two channels are shown by their difference.
    offset = facts.report_offset if len(names) == 1 else 0.0
    return values * facts.report_factor + offset, facts.report_unit


def _range(values: Array) -> tuple[float, float]:
    low, high = (float(v) for v in np.quantile(values, [TAIL, 1.0 - TAIL]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def mutual_information(x: Array, y: Array, bins: int = QUANTILES) -> float:
    """Return the mutual information in nat of two signals in bins of equal content.

    Less its expected value for independent ones.

    A value that is constant for a long time (a command in steady state) has its own bin, independent of its number of
    samples.
    """

    def ranked(values: Array) -> NDArray[np.intp]:
        edges = np.unique(np.quantile(values, np.linspace(0.0, 1.0, bins + 1)[1:-1]))
        return np.searchsorted(edges, values, side="right")

    # Evenly thinned: the estimate gains little from more samples, and the sort grows with them.
    step = max(1, len(x) // INFORMED)
    x, y = x[::step], y[::step]
    a, b = ranked(x), ranked(y)
    table = _count_cells([a, b], (int(a.max()) + 1, int(b.max()) + 1))
    share = table / len(x)
    outer = share.sum(axis=1, keepdims=True) * share.sum(axis=0, keepdims=True)
    seen = share > 0
    # Expected value for independent signals (Miller and Madow): (rows - 1) (columns - 1) / 2 n.
    chance = (np.count_nonzero(table.sum(axis=1)) - 1) * (np.count_nonzero(table.sum(axis=0)) - 1) / (2.0 * len(x))
    return float(max((share[seen] * np.log(share[seen] / outer[seen])).sum() - chance, 0.0))
