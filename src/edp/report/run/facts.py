"""Content of a run folder as plain data, without HTML and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import DataError, StorageError, count_of
from edp.evaluation.footprint_file import FootprintFile
from edp.evaluation.foundation_file import FoundationFile
from edp.evaluation.guard import MEASURE, MEASURE_NAME, network_verdict
from edp.evaluation.scores_file import MEAN, ModelScores, ScoredTarget, ScoresFile, error_at
from edp.report.run.outputs import by_output, describe_evaluation, losses_line, minutes_of, situation_line
from edp.settings.provenance import DataOrigin, Provenance
from edp.sim.limit_file import LimitFile
from edp.storage import JSON_BYTES, SETTINGS_BYTES, parse_json, parse_toml, read_text
from edp.storage.headers import check_files
from edp.storage.paths import is_file_at, is_folder_at
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import describe_unfinished
from edp.storage.seals import check_sealed_line, is_sealed_line
from edp.wording import decimals_for, figure, interval, interval_decimals, listed, number, percent, unit_text

NETWORK = "network"
TRUTH = "truth"
LOW, HIGH = "network_low", "network_high"
"""Names of the interval's lower and upper end in the arrays of a recording."""
INPUTS = "inputs"
"""Name of the raw signals of a recording, shape ``(time, channel)``, SI units."""
NO_MODELS = frozenset((TRUTH, LOW, HIGH, INPUTS))
"""Names in the arrays of a recording that are not predictions."""
MAKERS = {
    "config.toml": "edp train",
    "provenance.json": "edp train",
    "history.jsonl": "edp train",
    "scores.json": "edp evaluate",
    "predictions.safetensors": "edp evaluate",
    "footprint.json": "edp evaluate",
}
METRICS = ("rmse", "mae", "p95", "p99", "r2", "bias", "composite")


@dataclass(frozen=True)
class HistoryRow:
    """Epoch of a training, or check of a twin's training; None where a finite number is not stated.

    Attributes:
        epoch, update: number of the epoch, or of the update.
        seconds: training time so far, s.
        train_loss, validation_loss, validation_mae: values of a network; `validation` is the loss of a twin.
        learning_rate: base rate.
        best: whether these weights were kept.
    """

    epoch: float | None = None
    update: float | None = None
    seconds: float | None = None
    train_loss: float | None = None
    validation_loss: float | None = None
    validation_mae: float | None = None
    validation: float | None = None
    learning_rate: float | None = None
    best: bool = False

    @classmethod
    def from_table(cls, table: Mapping[str, object]) -> HistoryRow:
        """Return the row of a line of ``history.jsonl``; other values are left out."""
        names = {entry.name for entry in fields(cls)} - {"best"}
        numbers = {name: value for name, value in table.items() if name in names and isinstance(value, int | float)}
        finite = {name: value for name, value in numbers.items() if math.isfinite(value)}
        return cls(**finite, best=bool(table.get("best")))


@dataclass(frozen=True)
class Facts:
    """Content of a run folder; a missing part is None or empty, and `absent` names its file.

    Attributes:
        limit: the limit of predictability of the run's data, see `read_limit`.
        foundation: errors on machines that were never seen, of a run over many machines, see
            `edp.report.run.tables`.
        predictions: ``recording -> name -> array``; ``truth`` is (time, target), a model (time, horizon, target), SI;
            so are both ends of the network's interval, where it has one.
    """

    folder: Path
    config: str | None = None
    provenance: Provenance | None = None
    history: tuple[HistoryRow, ...] = ()
    scores: ScoresFile | None = None
    footprint: FootprintFile | None = None
    predictions: Mapping[str, Mapping[str, NDArray[np.floating]]] = field(default_factory=dict)
    absent: tuple[str, ...] = ()
    limit: LimitFile | None = None
    foundation: FoundationFile | None = None

    @property
    def targets(self) -> tuple[ScoredTarget, ...]:
        """The outputs, in the order of the arrays."""
        targets = () if self.scores is None else self.scores.targets
        return tuple(replace(target, description=target.description or target.name) for target in targets)

    @property
    def horizons(self) -> tuple[int, ...]:
        """Samples ahead, in the order of the arrays."""
        return () if self.scores is None else self.scores.task.horizons

    @property
    def rate_hz(self) -> float | None:
        """Return the samples per second, or None if the run does not state them."""
        task_rate = None if self.scores is None else self.scores.task.rate_hz
        rate = task_rate or (None if self.provenance is None else self.provenance.origin.rate_hz)
        return float(rate) if rate else None

    @property
    def models(self) -> dict[str, ModelScores]:
        """Scored models by name, the network first."""
        models = {} if self.scores is None else self.scores.models
        return {name: models[name] for name in sorted(models, key=lambda name: name != NETWORK)}

    @property
    def unit(self) -> str:
        """Return the common unit of all outputs; empty if they differ, because then a mean over outputs has no unit.

        Outputs without a unit have no common one: their numbers may be anything.
        """
        units = {target.unit for target in self.targets}
        shared = units.pop() if len(units) == 1 else ""
        return unit_text(shared)

    @property
    def averaged(self) -> bool:
        """Test whether a mean over the outputs has a meaning: one output, or several in one unit."""
        return len(self.targets) < 2 or bool(self.unit)


def read_facts(run_folder: str | Path, limit: str | Path | None = None) -> Facts:
    """Read every part of a run folder that is there.

    Args:
        run_folder: the folder.
        limit: file of the limit of predictability, or a folder with one; None reads that beside the run's data.

    Raises:
        StorageError: the folder is missing, holds no part of a run, or a part is damaged.
        DataError: the arrays of predictions do not fit the scored task.
    """
    folder = Path(run_folder)
    if not is_folder_at(folder):
        raise StorageError(f"no run folder at '{folder}'; give the folder that `edp train` wrote")
    if is_file_at(folder / "twin" / "twin.json"):
        raise StorageError(
            f"'{folder}' holds a twin, not a network that predicts; edp report writes its page, edp rollout runs it"
        )
    absent = tuple(name for name in MAKERS if not is_file_at(folder / name))
    if len(absent) == len(MAKERS):
        missing = f"'{folder}' is not a run folder: it holds none of {listed(MAKERS)}"
        raise StorageError(describe_unfinished(folder) or missing)

    provenance = None if PROVENANCE in absent else Provenance.read(folder)
    facts = Facts(
        folder=folder,
        config=None if "config.toml" in absent else read_settings(folder / "config.toml"),
        provenance=provenance,
        history=() if "history.jsonl" in absent else read_history(folder / "history.jsonl"),
        scores=None if "scores.json" in absent else ScoresFile.read(folder),
        footprint=None if "footprint.json" in absent else FootprintFile.read(folder),
        predictions={} if "predictions.safetensors" in absent else _read_predictions(folder),
        absent=absent,
        limit=read_limit(None if limit is None else Path(limit), provenance),
        foundation=FoundationFile.read(folder) if is_file_at(folder / FoundationFile.NAME) else None,
    )
    if facts.scores is not None and facts.predictions:
        check_files(facts.scores.files, folder, f"write it again with `edp evaluate {folder}`")
    _check_predictions(facts)
    return facts


def read_settings(path: Path) -> str:
    """Return the text of a run's settings, which is TOML.

    Raises:
        StorageError: it cannot be read, or is none.
    """
    text = read_text(path, SETTINGS_BYTES)
    try:
        parse_toml(text, f"'{path}'")
    except StorageError as error:
        raise StorageError(f"{error}; it was cut off or changed by hand: restore it, or train the run anew") from error
    return text


def read_history(path: Path) -> tuple[HistoryRow, ...]:
    """Return the epochs of a history file; a last line that a kill cut off is left out.

    Where one line has a hash, each must have it; files of earlier versions have none.

    Raises:
        StorageError: a line was changed, or is not a JSON object.
    """
    text = read_text(path, JSON_BYTES)
    lines = [(row, line) for row, line in enumerate(text.splitlines(), 1) if line.strip()]
    sealed = any(is_sealed_line(line) for _, line in lines)
    epochs: list[HistoryRow] = []
    for row, line in lines:
        where = f"'{path}' line {row}"
        if sealed:
            check_sealed_line(line, where, StorageError)
        try:
            epoch = parse_json(line, where, finite=False)
        except StorageError:
            if row == lines[-1][0] and not text.endswith("\n"):
                break
            raise
        if not isinstance(epoch, dict):
            raise StorageError(f"{where} holds {line[:40]!r}; each line must be one JSON object")
        epochs.append(HistoryRow.from_table(epoch))
    return tuple(epochs)


def read_limit(path: Path | None, provenance: Provenance | None) -> LimitFile | None:
    """Return the limit in a file, or in the folder of the run's data; None if missing.

    Raises:
        StorageError: the file that was named is missing, or a limit is damaged.
    """
    if path is None:
        origin = DataOrigin() if provenance is None else provenance.origin
        source = Path(str(origin.reader.get("path") or origin.source or ""))
        path = source / LimitFile.NAME
        if not is_folder_at(source) or not is_file_at(path):
            return None
    elif is_folder_at(path):
        path = path / LimitFile.NAME
    return LimitFile.from_file(path)


def _read_predictions(folder: Path) -> dict[str, dict[str, NDArray[np.floating]]]:
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    path = folder / "predictions.safetensors"
    try:
        arrays = load_file(path)
    except (OSError, SafetensorError) as error:
        raise StorageError(f"cannot read '{path}': {error}; write it again with `edp evaluate {folder}`") from error
    recordings: dict[str, dict[str, NDArray[np.floating]]] = {}
    for key in sorted(arrays):
        recording, _, name = key.rpartition("/")
        recordings.setdefault(recording, {})[name] = arrays[key]
    return {recording: parts for recording, parts in recordings.items() if TRUTH in parts}


def _check_predictions(facts: Facts) -> None:
    if facts.scores is None:
        return
    for recording, parts in facts.predictions.items():
        truth = parts[TRUTH]
        for name, array in parts.items():
            expected_shape = (
                (len(truth), len(facts.targets if name == TRUTH else facts.scores.inputs))
                if name in (TRUTH, INPUTS)
                else (
                    len(truth),
                    len(facts.horizons),
                    len(facts.targets),
                )
            )
            if array.shape != expected_shape:
                raise DataError(
                    f"predictions.safetensors, '{recording}/{name}' has shape {array.shape}, but scores.json asks for "
                    f"{expected_shape}; run `edp evaluate {facts.folder}` again so that both come from one evaluation"
                )


def horizon_text(facts: Facts, samples: int) -> str:
    """Return a horizon in milliseconds, or in samples if the rate is unknown."""
    if facts.rate_hz is None:
        return count_of(samples, "sample")
    return f"{figure(1000 * samples / facts.rate_hz)} ms"


def main_horizon(facts: Facts) -> int | None:
    """Return the longest horizon, the subject of the headline."""
    return max(facts.horizons, default=None)


def score(model: ModelScores | None, horizon: int, metric: str = MEASURE, output: str = MEAN) -> float | None:
    """Return an overall score of a model, or None where it was not computed."""
    return None if model is None else error_at(model.overall, horizon, output, metric)


def label_of(facts: Facts, name: str) -> str:
    """Return the name of a model in reports."""
    model = facts.models.get(name)
    return (model.label if model else "") or name.replace("_", " ")


@dataclass(frozen=True, kw_only=True)
class ComparisonRow:
    """A scored model in a comparison, in report units.

    Attributes:
        model: name.
        label: name in tables.
        rmse, mae, p95, p99, r2, bias, composite: means over outputs; None where not computed.
        change: relative change of the network's error against this model's (-0.45 is 45 % lower); None for the network.
        outputs: error by name of the output.
        seconds: training time.
    """

    model: str
    label: str
    rmse: float
    mae: float | None
    p95: float | None
    p99: float | None
    r2: float | None
    bias: float | None
    composite: float | None
    change: float | None
    outputs: Mapping[str, float | None]
    seconds: float | None

    @property
    def is_network(self) -> bool:
        """Whether the model is the network."""
        return self.model == NETWORK

    def metric(self, name: str) -> float | None:
        """Return a metric by its name in `METRICS`."""
        value: float | None = getattr(self, name)
        return value


def comparison_rows(facts: Facts, horizon: int | None = None) -> list[ComparisonRow]:
    """Return one row per scored model, least error (`MEASURE`) first."""
    samples = main_horizon(facts) if horizon is None else horizon
    if samples is None:
        return []
    ours = score(facts.models.get(NETWORK), samples)
    rows = []
    for name, model in facts.models.items():
        error = score(model, samples)
        if error is None:
            continue
        rows.append(
            ComparisonRow(
                model=name,
                label=label_of(facts, name),
                rmse=error,
                **{name: score(model, samples, name) for name in METRICS if name != MEASURE},
                change=ours / error - 1 if ours is not None and error > 0 and name != NETWORK else None,
                outputs={target.name: score(model, samples, output=target.name) for target in facts.targets},
                seconds=model.seconds,
            )
        )
    return sorted(rows, key=lambda row: row.rmse)


def headline(facts: Facts) -> str:
    """Return the verdict: outputs that a baseline predicts better, then the network's error at the longest horizon.

    Outputs in different units, or without one, have no common mean: each then stands by itself.
    """
    samples = main_horizon(facts)
    rows = comparison_rows(facts)
    if samples is None or not any(row.is_network for row in rows):
        missing = f"This run has no scores yet; `edp evaluate {facts.folder}` makes them"
        return f"{describe_unfinished(facts.folder) or missing}."
    judged = network_verdict(facts.scores, minutes_of(facts.folder)) if facts.scores else None
    figures = _figures(facts, rows, samples)
    return figures if judged is None else judged.headline(figures)


def _figures(facts: Facts, rows: Sequence[ComparisonRow], samples: int) -> str:
    if not facts.averaged and facts.scores:
        targets = [(target.name, target.description, target.unit) for target in facts.targets]
        return by_output(facts.scores, samples, targets, horizon_text(facts, samples))
    unit = facts.unit
    values = {row.model: row.rmse for row in rows}
    places = min(max(decimals_for(values.values(), significant=2), 1), 4 if unit else 8)
    parts = [f"{row.label} {number(row.rmse, places)}" for row in rows if not row.is_network]
    shown = parts if len(parts) <= 4 else [*parts[:3], f"{len(parts) - 3} more above that"]
    ours = f"{number(values[NETWORK], places)} {unit}".rstrip()
    start = f"At {horizon_text(facts, samples)} ahead the network is off by {ours}"
    return f"{'; '.join([f'{start} ({MEASURE_NAME})', *shown])}."


def limit_line(facts: Facts, samples: int | None) -> str:
    """State the limit at `samples` ahead; empty if it belongs to other signals or is unknown there."""
    limit = facts.limit
    if limit is None or samples is None or facts.rate_hz != limit.rate_hz or samples not in limit.horizons:
        return ""
    if tuple(target.name for target in facts.targets) != limit.targets or facts.unit != limit.unit:
        return ""
    row = limit.horizons.index(samples)
    unknown = limit.commands_unknown
    least, low, high = unknown.mae[row][-1], unknown.low[row][-1], unknown.high[row][-1]
    least_error = number(least, interval_decimals(low, high))
    error_with_commands = number(limit.commands_known.mae[row][-1], 2)
    return (
        f"The limit of predictability here is {least_error} {facts.unit} (95 %: {interval(low, high)}): even a "
        "predictor that "
        f"knows the true state has that mean absolute error, for it knows neither the operator's next choices nor the "
        f"noise to come; with the commands known, its error would be {error_with_commands}."
    )


def verdict_lines(facts: Facts) -> list[str]:
    """Explain the headline: against the best baseline, over the recordings, against the hardware budget."""
    lines = []
    rows = comparison_rows(facts)
    best = next((row for row in rows if row.change is not None), None)
    if best is not None and best.change is not None and facts.averaged:
        lower = best.change < 0
        # The headline compares each output by itself, this line all outputs together.
        lines.append(
            f"Over all outputs together its RMSE is {percent(abs(best.change))} {'lower' if lower else 'higher'} "
            f"than the best baseline, {best.label}{'' if lower else ': the network does not pay for itself here'}."
        )
        won, both = recordings_won(facts, best.model)
        if both:
            lines.append(f"It is the better of the two on {won} of {count_of(both, 'test recording')}.")
    lines += [line for line in (losses_line(facts.scores) if facts.scores else "",) if line]
    judged = describe_evaluation(facts.scores, facts.provenance) if facts.scores else ""
    beyond = situation_line(facts.scores) if facts.scores else ""
    limit = limit_line(facts, main_horizon(facts))
    lines += [line for line in (judged, beyond, limit) if line]
    footprint = facts.footprint
    if footprint is not None and footprint.stated_budget is not None and footprint.checks:
        over = [check.what for check in footprint.checks if not check.fits]
        verdict = f"exceeded in {listed(over)}" if over else "met on every count"
        lines.append(f"Budget ({footprint.stated_budget.name}): {verdict}.")
    return lines


def recordings_won(facts: Facts, baseline: str) -> tuple[int, int]:
    """Count the recordings on which the network has less mean error than a baseline, and the compared recordings."""
    samples = str(main_horizon(facts))

    def errors(name: str) -> dict[str, float]:
        scored = facts.models[name].recordings if name in facts.models else {}
        recording_errors = {key: value.get(samples, {}).get(MEAN, {}).get(MEASURE) for key, value in scored.items()}
        return {key: value for key, value in recording_errors.items() if value is not None}

    ours, theirs = errors(NETWORK), errors(baseline)
    both = ours.keys() & theirs.keys()
    return sum(ours[key] < theirs[key] for key in both), len(both)


def spread_text(facts: Facts) -> str:
    """State the spread of the network's error over the test recordings; empty if it was not computed."""
    spread = facts.models[NETWORK].spread.get(str(main_horizon(facts))) if NETWORK in facts.models else None
    if (
        not facts.averaged
        or not spread
        or any(spread.get(key) is None for key in ("median", "q25", "q75", "min", "max"))
    ):
        return ""
    places = decimals_for(spread[key] for key in ("median", "q25", "q75"))
    text = {key: number(spread[key], places) for key in ("median", "q25", "q75", "min", "max")}
    return (
        f"Over the test recordings the network's mean absolute error has a median of {text['median']} {facts.unit}; "
        f"half of them lie between {text['q25']} and {text['q75']}, the best at {text['min']} and the worst at "
        f"{text['max']}."
    )
