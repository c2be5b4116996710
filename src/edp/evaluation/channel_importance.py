"""Importance of each channel to a trained predictor: growth of its error when the channel is removed.

A channel is taken away without training again, in two ways. *Exchanged*, its whole course is that of another recording
(eq. 2.14 with recordings in place of rows, so that the course stays a plausible one and the stream can be run over it);
the error then grows with all that the network reads in the channel, and with the contradiction to other channels.
*Renewed*, only what the other channels, now and before, do not tell of it is that of another recording; the error grows
with what the channel alone can tell. Collinear channels stand in for one another in the first sense too, so they are
also taken away together.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.errors import ConfigError, DataError, closest
from edp.evaluation.conditional import OthersModel
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.progress import SILENT, Progress
from edp.settings.bounds import MAX_NAMES, MAX_ROWS, MOST_TICKS, SEED, check_bounds, integer
from edp.signals import KINDS

Array = NDArray[np.float64]
# Eight stretches give Student's t seven degrees of freedom: an interval that is wide, but means something.
PIECES = 8
"""Minimum number of segments for intervals. Recordings are divided if there are fewer."""
COVERAGE = 0.95


@dataclass(frozen=True, kw_only=True)
class ChannelImportanceSpec:
    """Settings for removing channels.

    Attributes:
        repeats: exchanges of each group, each with other recordings.
        groups: channels that are taken away together, beside each alone.
        lags: ticks back at which other channels may tell of a renewed one.
        rows: training rows that the rule for renewing is fitted on.
        skip: first ticks of each recording that are not scored; None leaves out a whole window.
        seed: random seed of the exchanges.
    """

    # Three donors a channel: one exchange may by chance bring a similar course.
    repeats: int = 3
    groups: tuple[tuple[str, ...], ...] = ()
    lags: tuple[int, ...] = (0, 1, 2, 4, 8, 16)
    rows: int = 40_000
    skip: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(
            "channel importance",
            self,
            repeats=integer(1, MAX_NAMES),
            lags=integer(0, MOST_TICKS),
            rows=integer(100, MAX_ROWS),
            skip=integer(0, MAX_ROWS),
            seed=SEED,
        )
        if 0 not in self.lags or min(self.lags) < 0:
            raise ConfigError(
                f"channel importance: lags = {list(self.lags)}; 0 must be among them, and nothing from the future"
            )


@dataclass(frozen=True)
class Growth:
    """Increase of the mean absolute error, in the target's report unit, with its 95 % interval over segments."""

    mean: float
    low: float
    high: float


@dataclass(frozen=True)
class ChannelImportance:
    """Importance of a channel, or of a group, at one horizon for one target or for their mean.

    Attributes:
        members: the removed channels.
        horizon: samples ahead.
        target: name, or ``mean``.
        exchanged: growth of the error with another recording's course.
        renewed: growth with another recording's surprise.
        explained: share of variance that the other channels explain, on training rows; mean over members.
    """

    members: tuple[str, ...]
    horizon: int
    target: str
    exchanged: Growth
    renewed: Growth
    explained: float


@dataclass(frozen=True)
class ChannelImportances:
    """Importances of all channels with the reference error.

    Attributes:
        rows: importance by group, horizon and target; the mean over targets comes first.
        error: mean absolute error with all channels, by horizon and target.
        units: report unit of each target; ``mean`` has that of the targets, where they share it.
        recordings: names of the evaluated recordings.
    """

    rows: tuple[ChannelImportance, ...]
    error: dict[str, dict[str, float]]
    units: dict[str, str]
    recordings: tuple[str, ...]

    def ranked(self, horizon: int) -> list[ChannelImportance]:
        """Return the means over the targets at a horizon, the largest renewed growth first."""
        chosen = [row for row in self.rows if row.horizon == horizon and row.target == "mean"]
        return sorted(chosen, key=lambda row: -row.renewed.mean)

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        return asdict(self)


def measure_channel_importance(
    predictor: Predictor,
    data: Prepared,
    spec: ChannelImportanceSpec | None = None,
    progress: Progress = SILENT,
) -> ChannelImportances:
    """Take every input channel of a predictor away, one at a time and in groups, on ``data.test``.

    Args:
        predictor: the network; channels that only a physics base reads are taken away like the others.
        data: prepared series: ``data.test`` is evaluated, ``data.train`` tells what channels say of each other.
        spec: settings.
        progress: receiver of the progress; its units are channels, or groups of them.

    Raises:
        ConfigError: a group names what is no input.
        DataError: no tick can be scored.
    """
    spec = spec or ChannelImportanceSpec()
    groups = _groups(data.task.inputs, spec.groups)
    ruler = _Ruler(data, predictor.spec.window if spec.skip is None else spec.skip)
    others = OthersModel.fit([part.inputs for part in data.train], spec.lags, spec.rows)
    places = [[data.task.inputs.index(name) for name in members] for members in groups]
    expected, explained = others.expect(places, [part.inputs for part in data.test])
    plain = ruler.errors(stream_predictions(predictor, data.test))
    # The same donors for every channel, so that channels differ by themselves and not by the draw.
    donors = [_donors(data.test, np.random.default_rng([spec.seed, turn])) for turn in range(spec.repeats)]
    rows: list[ChannelImportance] = []
    removals = progress.stage("channel", len(groups))
    for done, (members, columns) in enumerate(zip(groups, places, strict=True)):
        removals.note(", ".join(members))
        growths = []
        for base in ([np.zeros_like(values) for values in expected[done]], expected[done]):
            # All changed recordings go through the network together: streams side by side cost little more than one.
            changed = [part for turn in donors for part in _exchange_channels(data.test, columns, base, turn)]
            predictions, count = stream_predictions(predictor, changed), len(data.test)
            each = [ruler.errors(predictions[i * count : (i + 1) * count]) for i in range(spec.repeats)]
            growths.append(np.mean(each, axis=0) - plain)
        rows += ruler.rows(members, growths[0], growths[1], explained[done])
        removals.step(done + 1)
    return ChannelImportances(tuple(rows), ruler.table(plain), ruler.units(), tuple(part.name for part in data.test))


def _groups(inputs: Sequence[str], asked_groups: Sequence[Sequence[str]]) -> list[tuple[str, ...]]:
    """Return each input alone, then the groups of several."""
    for group in asked_groups:
        for name in group:
            if name not in inputs:
                raise ConfigError(
                    f"channel importance: group {list(group)} names '{name}', which is no input{closest(name, inputs)}"
                )
    alone = [(name,) for name in inputs]
    return alone + [tuple(group) for group in asked_groups if len(group) > 1]


@dataclass(frozen=True)
class _Donor:
    """Source of a recording's replacement values: another recording and its first row, cyclic."""

    recording: int
    start: int


def _donors(series: Sequence[Series], rng: np.random.Generator) -> list[_Donor]:
    """Return another recording for each; the same one, far off in time, where there is only one."""
    count = len(series)
    if count == 1:
        samples = series[0].samples
        # At least a quarter of the recording away, so that the course is not the recording's own, shifted by a little.
        return [_Donor(0, int(rng.integers(samples // 4, max(samples // 4 + 1, 3 * samples // 4))))]
    # A shift along a random order gives every recording another one, and each is used once.
    step, order = int(rng.integers(1, count)), rng.permutation(count)
    rank = np.argsort(order)
    others = [int(order[(rank[i] + step) % count]) for i in range(count)]
    return [_Donor(other, int(rng.integers(0, series[other].samples))) for other in others]


def _exchange_channels(
    series: Sequence[Series], columns: Sequence[int], base: Sequence[NDArray[np.float32]], donors: Sequence[_Donor]
) -> list[Series]:
    """Return the series with `columns` replaced by `base` plus the donor's deviation from its own base."""
    changed = []
    for part, own, donor in zip(series, base, donors, strict=True):
        rows = (np.arange(part.samples) + donor.start) % series[donor.recording].samples
        surprise = series[donor.recording].inputs[rows][:, columns] - base[donor.recording][rows]
        inputs = part.inputs.copy()
        inputs[:, columns] = (own + surprise).astype(np.float32)
        changed.append(replace(part, inputs=inputs))
    return changed


class _Ruler:
    """Mean absolute errors by segment, horizon and target, in report units."""

    def __init__(self, data: Prepared, skip: int) -> None:
        self.task, self.data = data.task, data
        self.facts = [KINDS[kind] for kind in data.target_kinds]
        self.factors = np.array([fact.report_factor for fact in self.facts])
        self.stretches: list[tuple[int, int, int]] = []
        cuts = max(1, math.ceil(PIECES / len(data.test)))
        for i, part in enumerate(data.test):
            edges = np.linspace(skip, part.samples - self.task.max_horizon, cuts + 1).astype(int)
            self.stretches += [(i, a, b) for a, b in itertools.pairwise(edges) if b > a]
        if not self.stretches:
            raise DataError(
                f"no tick of the test recordings can be scored: the longest has {max(p.samples for p in data.test)} "
                f"samples, the first {skip} are start-up; give longer recordings"
            )
        self.weights = np.array([b - a for _, a, b in self.stretches], dtype=float)

    def errors(self, predictions: Sequence[NDArray[np.float32]]) -> Array:
        """Return the errors, shape ``(stretch, horizon, 1 + target)``, with the mean over targets first."""
        errors = np.empty((len(self.stretches), len(self.task.horizons), len(self.task.targets)))
        for n, (i, start, stop) in enumerate(self.stretches):
            for h, horizon in enumerate(self.task.horizons):
                truth = self.data.test[i].targets[start + horizon : stop + horizon].astype(np.float64)
                errors[n, h] = np.abs(predictions[i][start:stop, h] - truth).mean(axis=0) * self.factors
        return np.concatenate([errors.mean(axis=2, keepdims=True), errors], axis=2)

    def rows(
        self, members: tuple[str, ...], exchanged: Array, renewed: Array, explained: float
    ) -> list[ChannelImportance]:
        """Return one row per horizon and target from the increases by segment."""
        return [
            ChannelImportance(
                members, horizon, name, self._growth(exchanged[:, h, n]), self._growth(renewed[:, h, n]), explained
            )
            for h, horizon in enumerate(self.task.horizons)
            for n, name in enumerate(("mean", *self.task.targets))
        ]

    def _growth(self, values: Array) -> Growth:
        share = self.weights / self.weights.sum()
        mean, count = float(share @ values), len(values)
        # One stretch says nothing about the spread; the interval is the value itself.
        if count < 2:
            return Growth(mean, mean, mean)
        # Stretches of unequal length weigh by their ticks: the error of such a mean, then Student's t.
        error = math.sqrt(float(share**2 @ (values - mean) ** 2) * count / (count - 1))
        reach = float(stdtrit(count - 1, 0.5 + COVERAGE / 2)) * error
        return Growth(mean, mean - reach, mean + reach)

    def table(self, errors: Array) -> dict[str, dict[str, float]]:
        """Return the errors over all ticks by horizon and target."""
        share = self.weights / self.weights.sum()
        names = ("mean", *self.task.targets)
        means = np.tensordot(share, errors, axes=1)
        return {
            str(horizon): dict(zip(names, map(float, means[h]), strict=True))
            for h, horizon in enumerate(self.task.horizons)
        }

    def units(self) -> dict[str, str]:
        """Report unit by target."""
        each = [fact.report_unit for fact in self.facts]
        shared = each[0] if len(set(each)) == 1 else "mixed units"
        return {"mean": shared, **dict(zip(self.task.targets, each, strict=True))}
