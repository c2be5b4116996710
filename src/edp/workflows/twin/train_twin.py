"""From recordings to a twin in a run folder, with its scores on free runs beside those of the floors."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edp import __version__
from edp.config.twin import TWIN_SETTINGS, TwinExperiment, twin_toml
from edp.data.prepared import Prepared
from edp.evaluation.free_run import calibrated
from edp.logs.source import DataSource
from edp.networks.twin import Twin, fit_scales
from edp.networks.twin.elements import ElementsTwin
from edp.networks.twin.grey.datasheet import BASIS, datasheet, datasheet_text
from edp.networks.twin.greybox import GreyTwin
from edp.networks.twin.recurrent import RecurrentTwin
from edp.networks.twin.residual import Residual, ResidualTwin
from edp.storage import write_bytes, write_json
from edp.storage.runs import KeyedRun, RunFolder, command_line, environment, run_key
from edp.training.elements_fit import fit_elements
from edp.training.free_run import FittedTwin, FreeRunProgress, fit_free_runs
from edp.training.grey_fit import fit_grey_box
from edp.training.residual_fit import fit_residual
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin
from edp.workflows.twin.judge_twin import SCORES, judge_twin, write_scores
from edp.workflows.twin.prepare_twin import driving_labels, prepare_twin, prepared_twin

FOLDER = "twin"
DATASHEET = "datasheet"
"""Numbers of a grey box with units and intervals, as JSON and as text."""


@dataclass(frozen=True, eq=False)
class TrainedTwin:
    """What `train_twin` leaves.

    Attributes:
        bundle: the twin on disk.
        scores: of the twin and of every floor, by label: see `edp.evaluation.free_run.free_run_scores`.
        resumed: whether it was finished before, and only read.
    """

    bundle: TwinBundle
    scores: dict[str, Any]
    resumed: bool


def train_twin(
    source: DataSource,
    experiment: TwinExperiment,
    out: str | Path,
    on_event: Callable[[FreeRunProgress], None] | None = None,
    on_step: Callable[[str], None] | None = None,
) -> TrainedTwin:
    """Train a twin and write a run folder: ``twin/``, settings, history, ``free_run.json``. A finished one is read,
    a stopped one goes on.

    Args:
        source: where the recordings are.
        experiment: the settings.
        out: run folder.
        on_event: called with progress of the training.
        on_step: called with what begins.

    Raises:
        EdpError: the recordings, settings or folder cannot be used; what was on disk stays.
    """
    tell = on_step or (lambda text: None)
    tell("reading recordings")
    recordings = source.read()
    channels, data = prepared_twin(recordings, experiment)
    labels = driving_labels(recordings)
    key = run_key({"twin": TWIN_SETTINGS.plain(experiment)}, data.digest)
    with RunFolder(out) as run:
        if run.claim(key, twin_toml(experiment)) and run.status().get("status") == "finished":
            bundle = load_twin(run.path)
            return TrainedTwin(bundle, dict(bundle.scores), True)
        run.write_status("running")
        scales = fit_scales(channels, data.train)
        started = time.process_time()
        twin = experiment.twin.start(channels, scales, data.train, experiment.training.seed)
        fitted, facts = _fitted(twin, experiment, data, KeyedRun(run, key), on_event, tell)
        fitted = replace(fitted, seconds=fitted.seconds or time.process_time() - started)
        run.write_history(fitted.history)
        tell("calibrating intervals")
        intervals = calibrated(fitted.twin, data.validation, experiment.judge)
        provenance = _provenance(source, experiment, data, fitted) | facts
        bundle = TwinBundle(experiment.twin, fitted.twin, provenance, {}, intervals)
        scores, runs = judge_twin(bundle, experiment, data, labels, tell)
        write_scores(run.path, scores, runs, intervals)
        bundle = replace(bundle, scores=scores)
        save_twin(bundle, run.file(FOLDER))
        run.write_status("finished")
    return TrainedTwin(bundle, scores, False)


def _fitted(
    twin: Twin,
    experiment: TwinExperiment,
    data: Prepared,
    keyed: KeyedRun,
    on_event: Callable[[FreeRunProgress], None] | None,
    tell: Callable[[str], None],
) -> tuple[FittedTwin, dict[str, Any]]:
    """The twin after what its formulation needs beyond its start, and what its provenance says of that."""
    seed, parts = experiment.training.seed, (data.train, data.validation)
    if isinstance(twin, RecurrentTwin):
        tell("training on free runs")
        return fit_free_runs(twin, *parts, experiment.training, on_event, keyed), {}
    if isinstance(twin, ElementsTwin):
        tell("fitting the elements to free runs")
        elements_fit = fit_elements(twin, *parts, seed, on_event)
        _write_datasheet(keyed.folder, elements_fit.rows)
        return FittedTwin(elements_fit.twin, elements_fit.history, elements_fit.seconds), {}
    if not isinstance(twin, GreyTwin):
        return FittedTwin(twin, [], 0.0), {}
    tell("fitting the grey box to free runs")
    fit = fit_grey_box(twin, *parts, seed, on_event)
    _write_datasheet(keyed.folder, datasheet(twin.table, fit.twin.numbers, fit.information))
    if not (isinstance(fit.twin, ResidualTwin) and isinstance(experiment.twin, Residual)):
        return FittedTwin(fit.twin, fit.history, fit.seconds), {}
    tell("training the network on top of the grey box")
    network = fit_residual(fit.twin, experiment.twin, *parts, experiment.training, on_event, keyed)
    if not network.helps:
        tell("the network does not help on the validation part: the grey box stays alone")
    fitted = FittedTwin(network.twin, fit.history + network.history, fit.seconds + network.seconds)
    return fitted, {"residual": network.facts()}


def _write_datasheet(run: RunFolder, rows: list[dict[str, Any]]) -> None:
    write_json(run.file(f"{DATASHEET}.json"), {"schema": 1, "basis": BASIS, "numbers": rows})
    write_bytes(run.file(f"{DATASHEET}.txt"), datasheet_text(rows).encode())


def _provenance(source: DataSource, experiment: TwinExperiment, data: Prepared, fitted: FittedTwin) -> dict[str, Any]:
    parts = {part: [series.name for series in getattr(data, part)] for part in ("train", "validation", "test")}
    return {
        "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": command_line(),
        "edp_version": __version__,
        "environment": environment(1),
        "seed": experiment.training.seed,
        "seconds": round(fitted.seconds, 2),
        "data": {"source": str(source.path), "reader": source.to_plain(), "digest": data.digest, "names": parts},
    }


__all__ = ["FOLDER", "SCORES", "TrainedTwin", "prepare_twin", "train_twin"]
