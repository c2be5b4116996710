"""Training as one call: recordings and settings in, a trained predictor in a folder out."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from edp.config.experiment import AUTO, Experiment, build, embed_feature_set, preset_table
from edp.data.features import FEATURE_SETS
from edp.errors import ConfigError, DataError, closest
from edp.logs.source import DataSource
from edp.logs.write import write_recording
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.tree import merged, read_toml, value_at, with_value
from edp.storage import make_folder
from edp.storage.paths import is_there
from edp.training import Diverged
from edp.training.progress_steps import training_steps
from edp.workflows import train_evaluate
from edp.workflows.api.predictor import TrainedPredictor
from edp.workflows.api.recordings import MemorySource, Recordings, to_recordings
from edp.workflows.auto import AutoSettings, auto_settings, train_auto

RECORDINGS = "recordings"
"""Folder of a run that holds the recordings of a training whose data came from memory."""


def train(
    data: Recordings | Recording | Sequence[Recording],
    targets: Sequence[str],
    horizons: Sequence[int] = (10,),
    *,
    test: Recordings | Recording | Sequence[Recording] | None = None,
    features: Sequence[str] | str | None = None,
    out: str | Path | None = None,
    preset: str | None = None,
    settings: Mapping[str, object] | str | Path | None = None,
    progress: Progress = SILENT,
) -> TrainedPredictor:
    """Train a predictor of `targets` some samples ahead; what `edp train` does, with the same settings.

    A training that was stopped goes on where `out` holds it, and one that is finished is read again.

    Args:
        data: recordings to train on.
        targets: channels to predict.
        horizons: look-ahead in samples; 10 samples are 0.1 s at 100 Hz.
        test: recordings that are set apart to evaluate on. Without them a part of `data` is, as the settings say (a
            fifth of the recordings; of a single recording its end).
        features: channels to read, or the name of a feature set. Without them those of the preset where the recordings
            have them all, else every channel.
        out: folder of the run; without it a temporary one, which is removed with the predictor.
        preset: ``auto`` trains a portfolio and keeps the simplest of the best, which its ``auto.json`` tells;
            ``quick``, ``small``, ``committee``, ``standard`` and ``thesis`` are one model each. Without a name
            ``auto``, or ``standard`` where `settings` hold some of the network or of its training.
        settings: laid over the preset: a TOML file, or a mapping with the keys of docs/settings.md, nested or dotted
            (``{"training.epochs": 3}``).
        progress: receiver of the progress: an object with the methods `stage`, `step` and `note` of
            `edp.progress.Progress`.

    Returns:
        The predictor with the weights of the best epoch.

    Raises:
        DataError: recordings that cannot be used, too short ones, or an unknown target.
        ConfigError: settings that cannot be.
        StorageError: the folder cannot be written or holds another run.
        Diverged: the loss was not finite any more.
    """
    recordings = to_recordings(data)
    tests = None if test is None else _apart(to_recordings(test), recordings)
    together = recordings if tests is None else Recordings([*recordings, *tests])
    experiment = _experiment(together, tests, targets, horizons, features, preset, settings)
    folder = Path(tempfile.mkdtemp(prefix="edp-run-")) if out is None else Path(out)
    source = together.source or MemorySource(folder / RECORDINGS, recordings=tuple(together))
    try:
        _train(source, experiment, folder, progress)
    # Even an interrupt must not leave a temporary folder behind, which nobody would find.
    except BaseException:
        if out is None:
            shutil.rmtree(folder, ignore_errors=True)
        raise
    return TrainedPredictor(folder, temporary=out is None)


def _train(
    source: DataSource,
    experiment: Experiment | AutoSettings,
    folder: Path,
    progress: Progress,
) -> None:
    try:
        if isinstance(experiment, AutoSettings):
            train_auto(source, experiment, folder, progress)
        else:
            train_evaluate.train(source, experiment, folder, training_steps(progress))
    # A diverged run keeps its best weights, which can only be judged with its recordings.
    except Diverged:
        _write(source)
        raise
    _write(source)


def _apart(tests: Recordings, recordings: Recordings) -> Recordings:
    """Rename test recordings whose names also occur in the training recordings."""
    names = [f"test {name}" if name in recordings.recording_names else name for name in tests.recording_names]
    return Recordings([replace(entry, name=name) for entry, name in zip(tests, names, strict=True)])


def _experiment(
    data: Recordings,
    tests: Recordings | None,
    targets: Sequence[str],
    horizons: Sequence[int],
    features: Sequence[str] | str | None,
    preset: str | None,
    settings: Mapping[str, object] | str | Path | None,
) -> Experiment | AutoSettings:
    if isinstance(targets, str):
        raise ConfigError(f"targets = '{targets}'; give a list of names, such as [\"{targets}\"]")
    if not isinstance(horizons, Sequence):
        raise ConfigError(f"horizons = {horizons}; give a list of samples ahead, such as [{horizons}]")
    own = _table(settings)
    preset = preset or ("standard" if {"model", "training"} & own.keys() else AUTO)
    table = preset_table(preset)
    task: dict[str, object] = {"targets": list(targets), "horizons": list(horizons)}
    if features is not None:
        task["features"] = features if isinstance(features, str) else {"name": "own", "channels": list(features)}
    elif value_at(own, "task.features") is None:
        name = value_at(table, "task.features")
        usual = FEATURE_SETS.get(str(name))
        task["features"] = name if usual is not None and set(usual.inputs) <= set(data.names) else "all"
    # Arguments and settings could contradict each other in silence; one of them is asked for.
    for key in ("targets", "horizons"):
        if value_at(own, f"task.{key}") is not None:
            raise ConfigError(f"settings: task.{key} is the argument `{key}` of edp.train; leave it out")
    table = merged(table, {"task": task})
    if tests is not None:
        if "split" in own:
            raise ConfigError(
                "settings: split and the argument `test` both set recordings apart; leave one of them out"
            )
        table["split"] = {"kind": "recordings", "test": list(tests.recording_names)}
    # A single recording cannot be split by recordings.
    elif len(data) == 1 and "split" not in own:
        table["split"] = {"kind": "time"}
    where, table = f"preset '{preset}' with settings", merged(table, own)
    experiment = auto_settings(table, where) if preset == AUTO else build(Experiment, table, where)
    _check_targets(data, experiment)
    return experiment


def _table(settings: Mapping[str, object] | str | Path | None) -> dict[str, object]:
    if settings is None:
        return {}
    if isinstance(settings, Mapping):
        return embed_feature_set(_nest_keys(settings), Path())
    return embed_feature_set(read_toml(settings), Path(settings).parent)


def _nest_keys(settings: Mapping[str, object]) -> dict[str, object]:
    """Return the dotted keys as tables, in the order given."""
    table: dict[str, object] = {}
    for key, value in settings.items():
        plain = _nest_keys(value) if isinstance(value, Mapping) else _plain(value)
        table = merged(table, with_value({}, str(key), plain))
    return table


def _plain(value: Any) -> Any:
    """Convert tuples to lists and mappings to dictionaries, as TOML would give them."""
    if isinstance(value, list | tuple):
        return [_nest_keys(entry) if isinstance(entry, Mapping) else _plain(entry) for entry in value]
    return value


def _check_targets(data: Recordings, experiment: Experiment | AutoSettings) -> None:
    physics = experiment.model.physics if isinstance(experiment, Experiment) else None
    task = experiment.task.resolve(data.rate_hz, data.names, physics)
    names = [*data.names, *(entry.name for entry in task.derived)]
    for target in task.targets:
        if target not in names:
            raise DataError(f"there is no channel '{target}' to predict{closest(target, names)}")


def _write(source: DataSource) -> None:
    """Write recordings in memory to the run folder, so that the run can be evaluated later."""
    if not isinstance(source, MemorySource):
        return
    folder = make_folder(source.path)
    for number, recording in enumerate(source.recordings):
        file = folder / f"{number:05d}.parquet"  # read back in this order
        # A resumed training finds the same files; writing them again would cost minutes of a large set.
        if not is_there(file):
            write_recording(recording, file)
