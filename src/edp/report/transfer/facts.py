"""Result of a transfer as tables, key figures and sentences."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.numpy import load_file

from edp.errors import StorageError, count_of
from edp.evaluation.guard import ErrorRatios, ErrorVerdict, best_verdict, by_recording
from edp.evaluation.scores_file import MEAN, Metrics, ScoredTarget, metric
from edp.evaluation.transfer_file import SOURCE, TARGET, MethodScores, TransferFile
from edp.storage.headers import check_files
from edp.storage.paths import is_file_at
from edp.table import Column, Table, Value, figures
from edp.wording import listed, number, percent, quantity, unit_text

SHOWN = "transfer_predictions.safetensors"
SIGNIFICANT = 0.05
"""Share of the MAE from which a bias is named."""


@dataclass(frozen=True)
class Transfer:
    """Content of ``transfer.json`` and of the excerpts in the same folder.

    Attributes:
        content: content of the file.
        shown: truth and predictions of excerpts by ``NAME/truth`` and ``NAME/METHOD``, ``(time, horizon, target)``, SI.
        folder: folder of the files.
    """

    content: TransferFile
    shown: Mapping[str, NDArray[np.float32]]
    folder: Path

    @property
    def horizons(self) -> list[str]:
        """Look-aheads in samples, as keys of scores."""
        return [str(horizon) for horizon in self.content.task.horizons]

    @property
    def targets(self) -> Sequence[ScoredTarget]:
        """Targets, in the order of the arrays."""
        return self.content.targets

    @property
    def unit(self) -> str:
        """Return the common unit of all targets, or "mixed units"."""
        units = {target.unit for target in self.targets}
        return unit_text(units.pop()) if len(units) == 1 else "mixed units"

    @property
    def methods(self) -> Mapping[str, MethodScores]:
        """All methods by name."""
        return self.content.methods

    @property
    def pair(self) -> tuple[str, str]:
        """Return the names of the methods for before and after."""
        return self.content.before, self.content.method

    @property
    def domains(self) -> list[str]:
        """Return the evaluated domains: the target, and the source if its recordings are available."""
        return list(self.methods[self.content.method].domains)

    def score(self, method: str, horizon: str, target: str = MEAN, domain: str = TARGET) -> Metrics:
        """Return the metrics of a method."""
        return self.content.score(method, horizon, target, domain)

    def mae(self, method: str, horizon: str, target: str = MEAN, domain: str = TARGET) -> float:
        """Return the mean absolute error of a method."""
        return metric(self.score(method, horizon, target, domain), "mae")

    def recordings(self, method: str, horizon: str) -> dict[str, float]:
        """Return the mean absolute error over targets of each log of the target; empty for earlier versions."""
        errors = {name: by_horizon.get(horizon) for name, by_horizon in self.methods[method].recordings.items()}
        return {name: error for name, error in errors.items() if error is not None}

    def gain(self, horizon: str) -> float:
        """Share of the MAE of direct transfer that is gone."""
        before, after = (self.mae(name, horizon) for name in self.pair)
        return 1 - after / before

    def ahead(self, horizon: str) -> str:
        """Return a horizon in words."""
        return f"{1e3 * int(horizon) / self.content.task.rate_hz:.0f} ms ahead (k = {horizon})"

    def name(self, target: ScoredTarget) -> str:
        """Return the readable name of a target."""
        return target.description or target.name


def read_transfer(folder: str | Path) -> Transfer:
    """Read the result of `edp train finetune` from a folder.

    Raises:
        StorageError: nothing, something of another version, or damaged excerpts.
    """
    if not is_file_at(Path(folder) / TransferFile.NAME):
        raise StorageError(f"'{folder}' holds no {TransferFile.NAME}; give the folder of edp train finetune")
    content = TransferFile.read(folder)
    check_files(content.files, folder, TransferFile.ADVICE)
    try:
        shown = load_file(Path(folder) / SHOWN)
    except (OSError, SafetensorError) as error:
        raise StorageError(
            f"'{Path(folder) / SHOWN}' cannot be read ({error}); run edp train finetune again"
        ) from error
    return Transfer(content, shown, Path(folder))


def transfer_tables(facts: Transfer, horizon: str) -> list[Table]:
    """Return the two tables of a horizon."""
    return [pair_table(facts, horizon), method_table(facts, horizon)]


def pair_table(facts: Transfer, horizon: str) -> Table:
    """Return a table in the form of Table 4.10: before and after, by target, with bias and skewness."""
    rows: list[tuple[Value, ...]] = []
    for method in facts.pair:
        for target in facts.targets:
            scores = facts.score(method, horizon, target.name)
            keys = ("mse", "mae", "r2", "p95", "p99", "bias", "skew")
            rows.append((facts.methods[method].label, facts.name(target), *(scores[key] for key in keys)))
    unit = facts.unit
    square = unit if unit in ("", "mixed units") else f"({unit})²"
    heads = (("MSE", square), ("MAE", unit), ("R²", ""), ("P95", unit), ("P99", unit), ("Bias", unit), ("Skew", ""))
    shows = [figures([row[2 + column] for row in rows]) for column in range(len(heads))]
    shows[2] = figures([], decimals=4)
    for column in (5, 6):
        shows[column] = figures([], signed=True, decimals=2)
    columns = (
        Column("Model variant"),
        Column("Target", is_text=True),
        *(Column(head, of, show) for (head, of), show in zip(heads, shows, strict=True)),
    )
    after = frozenset(range(len(facts.targets), 2 * len(facts.targets)))
    return Table(f"{facts.ahead(horizon)}, test part of the logs", columns, tuple(rows), after, name=f"pair_k{horizon}")


def method_table(facts: Transfer, horizon: str) -> Table:
    """Return all methods on the same ticks, sorted by error, in each evaluated domain."""
    direct = facts.mae(facts.content.before, horizon)
    both = SOURCE in facts.domains
    rows: list[tuple[Value, ...]] = []
    names = sorted(facts.methods, key=lambda name: facts.mae(name, horizon))
    for name in names:
        scores = facts.score(name, horizon)
        each = [facts.score(name, horizon, target.name) for target in facts.targets]
        r2_values = [row["r2"] for row in each if row["r2"] is not None]
        rows.append(
            (
                facts.methods[name].label,
                scores["mae"],
                100 * (facts.mae(name, horizon) / direct - 1),
                min(r2_values, default=None),
                scores["p95"],
                scores["p99"],
                max((metric(row, "bias") for row in each), key=abs),
                facts.methods[name].learned,
                *([facts.mae(name, horizon, domain=SOURCE)] if both else []),
            )
        )
    unit = facts.unit
    columns = (
        Column("Method"),
        Column("MAE", unit, figures([row[1] for row in rows])),
        Column("Against direct", "%", figures([], signed=True, decimals=1)),
        Column("Least R²", "", figures([], decimals=4)),
        Column("P95", unit, figures([row[4] for row in rows])),
        Column("P99", unit, figures([row[5] for row in rows])),
        Column("Largest bias", unit, figures([], signed=True, decimals=2)),
        Column("Learned", "parameters", figures([], decimals=0)),
        *([Column("MAE on the source", unit, figures([row[8] for row in rows]))] if both else []),
    )
    mark = frozenset({names.index(facts.content.method)})
    return Table(f"{facts.ahead(horizon)}, means over targets", columns, tuple(rows), mark, name=f"methods_k{horizon}")


def transfer_verdict(facts: Transfer) -> ErrorVerdict | None:
    """Return the verdict on the fine-tuned network against the best other method at the furthest horizon."""
    horizon, method = facts.horizons[-1], facts.content.method
    own, ratios = facts.mae(method, horizon), []
    for name in facts.methods:
        error = facts.mae(name, horizon)
        if name != method and own > 0 < error:
            theirs = facts.recordings(name, horizon)
            logs = {
                recording: [math.log(mae / theirs[recording])]
                for recording, mae in facts.recordings(method, horizon).items()
                if mae > 0 < theirs.get(recording, 0.0)
            }
            by_output = {MEAN: [math.log(own / error)]}
            ratios.append(ErrorRatios(facts.methods[name].label, by_output, by_recording(logs)))
    verdict = best_verdict(ratios, ErrorVerdict("", 0.0, (), "fine-tuned network"))
    if verdict is None:
        return None
    advice = f"take {verdict.label}, or give more recordings of this machine"
    # Errors are means over targets, so that no target is named.
    return replace(verdict, outputs=(), advice=advice)


def headline(facts: Transfer) -> str:
    """State the gain of the transfer in one sentence."""
    judged = transfer_verdict(facts)
    figures = _figures(facts)
    return figures if judged is None else judged.headline(figures)


def _figures(facts: Transfer) -> str:
    horizon = facts.horizons[-1]
    before, after = (facts.mae(name, horizon) for name in facts.pair)
    gain = facts.gain(horizon)
    if not gain:
        return "No epoch was better on the validation part than the source's network as it is, so that one is kept"
    how = f"{percent(abs(gain))} {'less' if gain > 0 else 'more'}"
    words = f"{number(after)} instead of {quantity(before, facts.unit)}"
    return f"{facts.methods[facts.content.method].label}: {how} error than direct transfer, {words}"


def verdict(facts: Transfer) -> list[str]:
    """Return sentences under the headline: R2 and bias of each target, the best baseline, the domain of the source."""
    horizon, method = facts.horizons[-1], facts.content.method
    each = {facts.name(target): facts.score(method, horizon, target.name) for target in facts.targets}
    r2_texts = listed(f"{number(row['r2'], 4)} ({name})" for name, row in each.items())
    lines = [f"R² is {r2_texts}."]
    leaning = [name for name, row in each.items() if abs(metric(row, "bias")) > SIGNIFICANT * metric(row, "mae")]
    if leaning:
        lines.append(f"The errors of {listed(leaning)} have a bias above {percent(SIGNIFICANT)} of their MAE.")
    baselines = [name for name in facts.methods if name != method]
    best = min(baselines, key=lambda name: facts.mae(name, horizon))
    if facts.mae(best, horizon) < facts.mae(method, horizon):
        better = facts.methods[best].label
        lines.append(f"{better} has less: {quantity(facts.mae(best, horizon), facts.unit)}.")
    if SOURCE in facts.domains:
        was, now = (facts.mae(name, horizon, domain=SOURCE) for name in facts.pair)
        change = percent(now / was - 1, signed=True)
        lines.append(f"On the source's own test part the error is {quantity(now, facts.unit)}, {change}.")
    return lines


def caveats(facts: Transfer) -> list[str]:
    """Return the limits of the evidence."""
    minutes = facts.content.data.minutes
    return [
        f"Trained on {minutes.train:.1f} min, epochs chosen on {minutes.validation:.1f} min, judged on "
        f"{minutes.test:.1f} min: the end of each of {count_of(facts.content.data.recordings, 'log')}, a "
        "gap of W + k "
        "apart.",
        "The test part holds the conditions of the logs, not others: another load or temperature is not in it.",
        "One training each: differences of a percent between methods may be chance.",
        *facts.content.notes,
    ]


def tiles(facts: Transfer) -> list[tuple[str, str, str]]:
    """Return the key figures: value, unit, meaning."""
    horizon, (before, after) = facts.horizons[-1], facts.pair
    was, now = facts.score(before, horizon), facts.score(after, horizon)
    return [
        (number(now["mae"]), facts.unit, f"MAE {facts.ahead(horizon)}"),
        (number(was["mae"]), facts.unit, "MAE of direct transfer"),
        (percent(facts.gain(horizon)), "", "less error"),
        (number(now["p99"]), facts.unit, "99th percentile of the error"),
        (f"{facts.content.data.minutes.train:.1f}", "min", "of logs trained on"),
    ]
