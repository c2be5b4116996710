"""The main jobs as functions: simulate, train, evaluate, report. The command line and scripts call the same ones."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.numpy import save

from edp import __version__
from edp.config import (
    Experiment,
    experiment_toml,
    load_experiment,
    plain_tree,
)
from edp.data.coverage import Coverage, cover
from edp.data.prepared import Prepared, prepare
from edp.data.spectrum import LAGS
from edp.data.splits import SPLITS
from edp.errors import ConfigError, DataError, StorageError, closest
from edp.evaluation.footprint import Budget, Footprint, footprint
from edp.evaluation.judge import Evaluation, JudgeSpec, judge
from edp.logs import LAYOUTS, WriteOptions, known_suffixes, read_recording, write_recording
from edp.models.predictor import ModelSpec, Predictor, build_model, describe
from edp.recording import Recording
from edp.report import build_report
from edp.runs import RunFolder, command_line, environment, run_key
from edp.sources import DataSource
from edp.storage import make_folder, read_json, write_bytes, write_json
from edp.training import Bundle, Event, fit, load_bundle, make_bundle, save_bundle
from edp.training.bundle import blank_scaler, weights_digest
from edp.training.fit import thread_count

SHOWN_RECORDINGS = 6
SHOWN_TICKS = 60_000
MANIFEST = "data_set.json"


@dataclass(frozen=True, kw_only=True)
class SimulationOrder:
    """A simulated data set: the same order gives the same bits, whatever the number of workers.

    Attributes:
        machine: machine parameter set.
        minutes: length of all recordings together.
        recordings: how many recordings.
        seed: root of every random choice.
        family: how many machines of 10 to 50 t take turns in place of `machine`; 0 for none.
        suffix: ending of the logs, which settles their format.
        layout: layout of MAT files, a name in `edp.logs.LAYOUTS`; empty for the plain one.
        truth: where the channels go that only a simulation knows, see `edp.logs.WriteOptions`; empty for ``apart``
            in a layout that was asked for, else ``with`` the others.
    """

    machine: str = "M22"
    minutes: float = 60.0
    recordings: int = 30
    seed: int = 0
    family: int = 0
    suffix: str = ".parquet"
    layout: str = ""
    truth: str = ""

    def files(self) -> WriteOptions:
        """How the logs are written.

        Raises:
            EdpError: an ending without a format, an unknown layout, or one of another format.
        """
        if self.suffix not in known_suffixes():
            hint = closest(self.suffix, known_suffixes())
            raise ConfigError(f"there is no log format for the ending '{self.suffix}'{hint}")
        if self.layout:
            LAYOUTS[self.layout]
            if self.suffix != ".mat":
                raise ConfigError(f"layout '{self.layout}' is one of MAT files, not of '{self.suffix}'; ask for mat")
        truth = self.truth or ("apart" if self.layout else "with")
        return WriteOptions(mat_layout=self.layout or WriteOptions.mat_layout, truth=truth)


def simulate_data_set(
    out: str | Path,
    order: SimulationOrder | None = None,
    workers: int = 0,
    on_done: Callable[[Recording, bool], None] | None = None,
) -> list[Path]:
    """Simulate a data set into a folder, a log each; logs already there from the same order are kept.

    Args:
        out: folder; it may hold nothing but an earlier part of the same data set.
        order: what to simulate; an hour of machine M22 by default.
        workers: processes; 0 for one a core.
        on_done: called with each recording and whether it was there already.

    Raises:
        StorageError: the folder holds another data set or cannot be written.
        ConfigError: an ending without a format, or a number out of range.
    """
    from edp.sim import over_family, plan_data_set, simulate_many

    order = order or SimulationOrder()
    suffix, files = order.suffix, order.files()
    plan = plan_data_set(order.machine, order.minutes, order.recordings, order.seed)
    if order.family:
        plan = over_family(plan, order.family, order.seed)
    folder = make_folder(out)
    identity = {"schema": 1, "edp": __version__, "plan": [asdict(entry) for entry in plan]}
    if files != WriteOptions():
        identity["files"] = asdict(files)
    manifest = folder / MANIFEST
    if manifest.exists() and read_json(manifest) != identity:
        raise StorageError(f"'{folder}' holds another simulated data set; nothing was changed: choose another folder")
    write_json(manifest, identity)
    paths = [folder / f"{scenario.name}{suffix}" for scenario in plan]
    missing = [scenario for scenario, path in zip(plan, paths, strict=True) if not path.exists()]
    for scenario, path in zip(plan, paths, strict=True):
        if on_done is not None and scenario not in missing:
            on_done(read_recording(path), True)
    count = workers or os.cpu_count() or 1
    for recording in simulate_many(missing, min(count, max(1, len(missing)))):
        write_recording(recording, folder / f"{recording.name}{suffix}", files)
        if on_done is not None:
            on_done(recording, False)
    return paths


def coverage(source: DataSource, inputs: Sequence[str] = (), split: str = "") -> Coverage:
    """What a data set covers: see `edp.data.coverage`.

    Args:
        source: where the recordings are.
        inputs: channels that command, where neither names nor kinds tell.
        split: name of a split with its usual settings, to say how far tests lie from training.

    Raises:
        EdpError: the recordings cannot be read as they are, or do not command or move anything; an unknown split.
    """
    chosen = SPLITS[split]() if split else None
    recordings = source.read()
    return cover(recordings, inputs, None if chosen is None else chosen.split(recordings, LAGS))


def prepare_data(source: DataSource, experiment: Experiment) -> Prepared:
    """Read and cut a data set for an experiment."""
    recordings = source.read()
    first = recordings[0]
    task = experiment.task.resolve(first.rate_hz, first.channel_names)
    return prepare(recordings, task, experiment.split, experiment.model.window)


def train(
    source: DataSource,
    experiment: Experiment,
    out: str | Path,
    on_event: Callable[[Event], None] | None = None,
) -> Bundle:
    """Train on a data set and write a run folder with its bundle; an interrupted run goes on where it stopped.

    Args:
        source: where the recordings are.
        experiment: the settings.
        out: run folder.
        on_event: called with progress.

    Raises:
        EdpError: the data, settings or folder cannot be used; what was on disk stays.
    """
    data = prepare_data(source, experiment)
    settings = {part: values for part, values in plain_tree(experiment).items() if part != "judge"}
    key = run_key(settings, data.digest)
    with RunFolder(out) as run:
        run.claim(key, experiment_toml(experiment))
        fitted = fit(data, experiment.model, experiment.training, (run, key), on_event)
        provenance = _provenance(source, experiment, data, fitted.seconds)
        write_json(run.file("provenance.json"), provenance)
        write_json(run.file("footprint.json"), footprint(fitted.predictor).to_json(Budget()))
        bundle = make_bundle(fitted.predictor, data, provenance)
        save_bundle(bundle, run.file("bundle"))
    return bundle


def _provenance(source: DataSource, experiment: Experiment, data: Prepared, seconds: float) -> dict[str, Any]:
    rate = data.task.rate_hz

    def part(series: Sequence[Any]) -> dict[str, Any]:
        hours = sum(entry.samples for entry in series) / rate / 3600
        return {"recordings": len(series), "hours": round(hours, 4), "names": [entry.name for entry in series]}

    return {
        "edp_version": __version__,
        "created": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "command": command_line(),
        "seed": experiment.training.seed,
        "environment": environment(thread_count(experiment.training)),
        "regime": experiment.training.chunks.regime,
        "seconds": round(seconds, 2),
        "device": experiment.training.device,
        "data": {
            "source": str(source.path),
            "reader": source.to_plain(),
            "rate_hz": rate,
            "train": part(data.train),
            "validation": part(data.validation),
            "test": part(data.test),
            "digest": data.digest,
        },
    }


def evaluate(
    run: str | Path,
    source: DataSource | None = None,
    baselines: Sequence[str] | None = None,
    on_step: Callable[[str], None] | None = None,
) -> Path:
    """Judge a run on its held-out recordings, or on other ones, beside baselines trained on its training data.

    Scores of the same weights, recordings and settings are kept, not computed again.

    Args:
        run: run folder.
        source: other recordings; all of them are judged.
        baselines: names; None takes those of the settings.
        on_step: called with the name of each model before it runs.

    Returns:
        The folder with ``scores.json`` and ``predictions.safetensors``: the run folder, or one in it for `source`.
    """
    folder = Path(run)
    bundle = load_bundle(folder)
    if not (folder / "provenance.json").is_file():
        raise StorageError(f"'{folder}' is not a run folder: it has no provenance.json; give the folder of edp train")
    provenance = read_json(folder / "provenance.json")
    experiment = load_experiment(folder / "config.toml", preset=None)
    torch.set_num_threads(thread_count(experiment.training))  # the ticks of a stream are too small to share
    data = prepare_data(DataSource.from_plain(provenance["data"]["reader"]), experiment)
    if data.digest != provenance["data"]["digest"]:
        raise DataError(
            f"the recordings in '{provenance['data']['source']}' changed since '{folder}' was trained; the held-out "
            "split would not be the same: train again, or judge other recordings with --data"
        )
    target, judged = folder, [data.digest]
    if source is not None:
        recordings = source.read()
        data = replace(data, test=[bundle.task.series(recording) for recording in recordings])
        judged += [part for recording in recordings for part in (recording.name, recording.digest)]
        target = make_folder(folder / f"on_{source.path.stem}")
    chosen = experiment.judge if baselines is None else replace(experiment.judge, baselines=tuple(baselines))
    settings = plain_tree(replace(experiment, judge=chosen))["judge"]
    key = run_key({"judge": settings, "weights": weights_digest(bundle.predictor)}, " ".join(judged))
    scores = _kept(target, key)
    if scores is None:
        found = judge(bundle.predictor, data, chosen, describe(bundle.predictor.spec), provenance["seconds"], on_step)
        scores = found.scores | {"key": key}
        write_bytes(target / "predictions.safetensors", save(_shown(found)))
        write_json(target / "scores.json", scores)
    if source is None:
        save_bundle(replace(bundle, scores=scores["models"]["network"]["overall"]), folder / "bundle")
    return target


def _kept(folder: Path, key: str) -> dict[str, Any] | None:
    """Scores of an earlier judgement of the same things."""
    if not (folder / "scores.json").is_file() or not (folder / "predictions.safetensors").is_file():
        return None
    scores = read_json(folder / "scores.json")
    return scores if scores.get("key") == key else None


def _shown(found: Evaluation) -> dict[str, np.ndarray]:
    """Truth and predictions of a few recordings, for the report."""
    tensors: dict[str, np.ndarray] = {}
    for i, series in enumerate(found.series[:SHOWN_RECORDINGS]):
        tensors[f"{series.name}/truth"] = np.ascontiguousarray(series.targets[:SHOWN_TICKS])
        for name in ("network", "ridge_arx"):
            if name in found.predictions:
                tensors[f"{series.name}/{name}"] = np.ascontiguousarray(found.predictions[name][i][:SHOWN_TICKS])
    return tensors


def judge_bundle(bundle: Bundle, data: Prepared, spec: JudgeSpec | None = None) -> Evaluation:
    """Judge a bundle on ``data.test`` without touching the disk."""
    return judge(bundle.predictor, data, spec or JudgeSpec(), describe(bundle.predictor.spec))


def footprint_of(path: str | Path) -> tuple[Footprint, str]:
    """Footprint of a bundle, a run folder, or a settings file, and what it is called.

    Raises:
        EdpError: neither a bundle nor valid settings.
    """
    source = Path(path)
    if source.suffix == ".toml":
        experiment = load_experiment(source)
        task = experiment.task.resolve(100.0)
        return footprint(_untrained(experiment.model, task)), source.stem
    bundle = load_bundle(source)
    return footprint(bundle.predictor), describe(bundle.predictor.spec)


def _untrained(model: ModelSpec, task: Any) -> Predictor:
    return build_model(task, model, blank_scaler(task), seed=0)


__all__ = [
    "DataSource",
    "SimulationOrder",
    "build_report",
    "coverage",
    "evaluate",
    "footprint_of",
    "judge_bundle",
    "prepare_data",
    "simulate_data_set",
    "train",
]
