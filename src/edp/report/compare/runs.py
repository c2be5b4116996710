"""Facts of each run for a comparison: errors by quantity and recording, learning curve, size, cost."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError, count_of
from edp.evaluation.controller import Budget
from edp.evaluation.free_run_file import TWIN, ChannelErrors
from edp.report.run.facts import NETWORK, TRUTH, Facts, HistoryRow, label_of, read_facts, read_history
from edp.report.twin.facts import holds_free_runs, read_free_runs
from edp.settings.provenance import Provenance
from edp.settings.tree import value_at
from edp.storage import read_object
from edp.storage.paths import full_path, is_file_at
from edp.storage.runs import describe_unfinished
from edp.wording import figure, unit_text

MAX_RUNS = 12
"""Maximum number of compared runs. More lines are not distinguishable in a chart."""
MEAN = "mean over outputs"
LOOK_AHEAD, FREE = "looks ahead", "runs free"
HEADER = "twin/twin.json"
Array = NDArray[np.floating]


@dataclass(frozen=True, order=True)
class Measure:
    """An error by which runs are compared.

    Attributes:
        output: name of a target or channel, or `MEAN` where all targets have one unit.
        ahead_s: seconds ahead, or after the start of a free run.
        unit: unit of the error.
        what: description of the measure.
    """

    output: str
    ahead_s: float
    unit: str
    what: str = "mean absolute error"

    def text(self) -> str:
        """Return the text for a heading."""
        return f"{self.output}, {self.when}"

    @property
    def when(self) -> str:
        """Name the quantity and the horizon."""
        return f"{figure(1000 * self.ahead_s)} ms ahead" if self.what == "mean absolute error" else self.what


@dataclass(frozen=True, eq=False)
class ComparedRun:
    """One run.

    Attributes:
        name: name in the comparison.
        folder: folder of the run.
        kind: `LOOK_AHEAD` or `FREE`.
        label: label of its model.
        errors: error of each test recording, by measure.
        curves: seconds and error of a free run, by output.
        history: an entry an epoch; empty where it has none.
        costs: size and work by words; what is not known is left out.
        digest: hash of its data; empty if unknown.
        predictions: by recording, ``truth`` ``(time, target)`` and ``network`` ``(time, horizon, target)``, SI units.
        targets: outputs in the order of these arrays, with the factor to the report's unit.
        horizons: samples ahead in the order of these arrays.
        rate_hz: sample rate of the data; None if unknown.
        skip: first ticks of each recording that are not scored.
    """

    name: str
    folder: Path
    kind: str
    label: str
    errors: Mapping[Measure, Mapping[str, float]]
    curves: Mapping[str, tuple[Sequence[float], Sequence[float | None]]] = field(default_factory=dict)
    history: tuple[HistoryRow, ...] = ()
    costs: Mapping[str, float] = field(default_factory=dict)
    digest: str = ""
    predictions: Mapping[str, Mapping[str, Array]] = field(default_factory=dict)
    targets: tuple[tuple[str, float], ...] = ()
    horizons: tuple[int, ...] = ()
    rate_hz: float | None = None
    skip: int = 0

    def target(self, name: str) -> tuple[int, float] | None:
        """Return the column of a target in the arrays and its factor to the report unit; None for an unknown target."""
        places = {target: (column, factor) for column, (target, factor) in enumerate(self.targets)}
        return places.get(name)

    @property
    def recordings(self) -> set[str]:
        """Test recordings that every measure has."""
        sets = [set(by_name) for by_name in self.errors.values()]
        return set.intersection(*sets) if sets else set()


def read_runs(folders: Sequence[str | Path]) -> list[ComparedRun]:
    """Read the runs of some folders, in that order.

    Args:
        folders: run folders, or folders in them that `edp evaluate --data` wrote.

    Raises:
        ConfigError: fewer than two, more than `MAX_RUNS`, or one twice.
        StorageError: a folder holds no evaluated run, or something damaged.
        DataError: some of them look ahead and others run free.
    """
    paths = [Path(folder) for folder in folders]
    if not 2 <= len(paths) <= MAX_RUNS:
        raise ConfigError(f"{count_of(len(paths), 'run')} came; edp compare takes 2 to {MAX_RUNS} run folders")
    real = [full_path(path) for path in paths]
    for position, path in enumerate(real):
        if path in real[:position]:
            raise ConfigError(f"'{paths[position]}' came twice; name each run once")
    runs = [
        _twin(path, name) if holds_free_runs(path) else _network(path, name)
        for path, name in zip(paths, _names(real), strict=True)
    ]
    if len({run.kind for run in runs}) > 1:
        free = [run.name for run in runs if run.kind == FREE]
        raise DataError(
            f"{', '.join(free)}: a twin runs free, the others look a fixed time ahead; their errors are not the same "
            "quantity. Compare twins with twins, and networks with networks (edp evaluate TWIN --predictor RUN sets a "
            "twin beside a network)"
        )
    return runs


def _names(paths: Sequence[Path]) -> list[str]:
    """Return the last part of each path, or as many parts as make the names different."""
    for parts in range(1, 6):
        names = ["/".join(path.parts[-parts:]) for path in paths]
        if len(set(names)) == len(names):
            return names
    return [str(path) for path in paths]


def _network(path: Path, name: str) -> ComparedRun:
    facts = read_facts(path)
    if facts.scores is None or NETWORK not in facts.models:
        raise DataError(describe_unfinished(path) or f"'{path}' was not judged; run edp evaluate {path}")
    # What edp evaluate --data writes is a folder in the run, which has the rest.
    whole = facts
    if facts.provenance is None and is_file_at(full_path(path).parent / "provenance.json"):
        whole = read_facts(full_path(path).parent)
    errors: dict[Measure, dict[str, float]] = {}
    horizons = {str(horizon) for horizon in facts.horizons}
    for recording, by_horizon in facts.models[NETWORK].recordings.items():
        for horizon, scores in by_horizon.items():
            for output, unit in _outputs(facts) if horizon in horizons else ():
                alone = output == MEAN or len(facts.targets) == 1
                error = scores.get("mean" if alone else output, {}).get("mae")
                if error is not None:
                    measure = Measure(output, round(int(horizon) / (facts.rate_hz or 1.0), 9), unit)
                    errors.setdefault(measure, {})[recording] = float(error)
    if not errors:
        raise DataError(f"'{path}' has no errors by recording; remove its scores.json and run edp evaluate {path}")
    return ComparedRun(
        name=name,
        folder=path,
        kind=LOOK_AHEAD,
        label=label_of(facts, NETWORK),
        errors=errors,
        history=whole.history,
        costs=_costs(whole),
        digest=(facts.provenance or Provenance()).origin.digest or "",
        predictions=facts.predictions,
        targets=tuple((target.name, target.factor) for target in facts.targets),
        horizons=facts.horizons,
        rate_hz=facts.rate_hz,
        skip=facts.scores.task.skip,
    )


def _outputs(facts: Facts) -> list[tuple[str, str]]:
    """Return name and unit of each output with errors; the mean is first if all outputs have the same unit."""
    outputs = [(target.name, unit_text(target.unit)) for target in facts.targets]
    if len(outputs) == 1:
        return outputs
    return [(MEAN, facts.unit), *outputs] if facts.averaged else outputs


def _costs(facts: Facts) -> dict[str, float]:
    """Return the costs that the footprint states."""
    footprint = facts.footprint
    if footprint is None:
        return {}
    costs: dict[str, int | None] = {
        "Parameters": footprint.parameters,
        "Multiply-accumulates per tick": footprint.macs_tick,
    }
    for row in footprint.estimates:
        cycles, name = row.cycles.get((footprint.budget or Budget()).core), row.number_format[:20]
        costs[f"Cycles per tick, {name}"] = None if cycles is None else cycles[1]  # low, typical, high
        costs[f"Flash, {name} [B]"] = row.flash_bytes
    return _positive(costs)


def _positive(values: Mapping[str, object]) -> dict[str, float]:
    numbers = {name: value for name, value in values.items() if isinstance(value, int | float) and value is not True}
    return {name: float(value) for name, value in numbers.items() if 0 < value < math.inf}


def _twin(path: Path, name: str) -> ComparedRun:
    facts = read_free_runs(path)
    twin = facts.twin
    errors: dict[Measure, dict[str, float]] = {}
    for recording, scores in twin.by_recording.items():
        for end in scores.stroke_error:
            _add(errors, end, recording, f"stroke error after {figure(end.at_s)} s", end.at_s)
        _add(errors, scores.velocity_mae, recording, "velocity error over the run", twin.seconds)
    horizons = twin.by_horizon
    curves = {output: (horizons.seconds, values) for output, values in horizons.strokes.by_channel.items()}
    history = path / "history.jsonl"
    header = read_object(path / HEADER) if is_file_at(path / HEADER) else {}
    return ComparedRun(
        name=name,
        folder=path,
        kind=FREE,
        label=str(value_at(header, "twin.kind", TWIN)),
        errors=errors,
        curves=curves,
        history=read_history(history) if is_file_at(history) else (),
        costs=_positive({"Parameters": facts.provenance.more.get("parameters")}),
        digest=facts.provenance.origin.digest or "",
    )


def _add(errors: dict[Measure, dict[str, float]], row: ChannelErrors, recording: str, what: str, at: float) -> None:
    """Add the errors of one recording by channel, and their mean if all channels have the same unit."""
    values = ({MEAN: row.mean} if row.unit and len(row.by_channel) > 1 else {}) | dict(row.by_channel)
    for output, value in values.items():
        if value is not None:
            errors.setdefault(Measure(output, at, row.unit_of(output), what), {})[recording] = value


def recording_that_differs(first: ComparedRun, second: ComparedRun, names: set[str]) -> str:
    """Return the name of a recording whose content differs between two runs; empty if all common ones agree."""
    for name in sorted(names & first.predictions.keys() & second.predictions.keys()):
        shared = [target for target, _ in first.targets if second.target(target) is not None]
        parts = []
        for run in (first, second):
            columns = [column for target in shared if (where := run.target(target)) for column in where[:1]]
            parts.append(run.predictions[name][TRUTH][:, columns])
        if parts[0].shape != parts[1].shape or not np.allclose(parts[0], parts[1], atol=1e-7, equal_nan=True):
            return name
    return ""
