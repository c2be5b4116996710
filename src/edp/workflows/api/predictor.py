"""Trained predictor on disk: evaluate, predict, plot, export and stream it."""

from __future__ import annotations

import hashlib
import shutil
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from edp.data.prepared import Prepared
from edp.data.unlabelled import unlabelled
from edp.errors import ConfigError
from edp.evaluation.judge import JudgeSpec
from edp.networks import AdaptedStream, Stream
from edp.networks.predictor import Predictor
from edp.networks.running import stream_intervals, stream_predictions
from edp.recording import Recording
from edp.report import Facts, read_facts
from edp.report.notebook import html_of, text_of
from edp.signals import KINDS
from edp.storage.paths import is_file_at
from edp.table import Column, Table
from edp.training import load_bundle
from edp.wording import typed
from edp.workflows import deployment, train_evaluate
from edp.workflows.api.predictions import Predictions
from edp.workflows.api.recordings import MemorySource, Recordings, to_recordings
from edp.workflows.api.scores import JudgedScores

BASELINES = ("persistence", "ridge_arx")
"""Baselines that take seconds; the others, `trees` and `mlp` among them, are asked for by name."""
PROVENANCE = "provenance.json"
"""File that distinguishes a run folder from a bundle: the origin of the training data."""


class TrainedPredictor:
    """A network with its scaling, and the run folder around it where there is one.

    Args:
        folder: a run folder, or a bundle.
        temporary: the folder is removed with this object.

    Raises:
        BundleError: neither a run folder nor a bundle, or a damaged one.
    """

    def __init__(self, folder: str | Path, temporary: bool = False) -> None:
        self._folder = Path(folder)
        if temporary:
            # Temporary folders go with the object; a folder that the user named stays.
            weakref.finalize(self, shutil.rmtree, self._folder, ignore_errors=True)
        self._bundle = load_bundle(self._folder)
        self._task = self._bundle.task

    @property
    def folder(self) -> Path:
        """The run folder or bundle."""
        return self._folder

    @property
    def inputs(self) -> tuple[str, ...]:
        """Input channels of each sample, in order, SI units."""
        return self._task.inputs

    @property
    def targets(self) -> tuple[str, ...]:
        """Channels that are predicted."""
        return self._task.targets

    @property
    def horizons(self) -> tuple[int, ...]:
        """Look-ahead in samples."""
        return self._task.horizons

    @property
    def rate_hz(self) -> float:
        """Sampling rate of the inputs in Hz."""
        return self._task.rate_hz

    @property
    def units(self) -> dict[str, str]:
        """SI unit of each input and target, by name."""
        targets = zip(self.targets, self._bundle.target_kinds, strict=True)
        return {c.name: c.unit for c in self._bundle.inputs} | {name: KINDS[kind].si_unit for name, kind in targets}

    @property
    def network(self) -> Predictor:
        """The network as a PyTorch module (`torch.nn.Module`), in evaluation mode, with its scaling inside.

        ``network.predict(x, state)`` takes `inputs` in SI units, shape ``(batch, time, input)``, float32, and returns
        predictions in SI units, shape ``(batch, time, horizon, target)``, with the next state. ``network(x, state)``
        is the same before the last scaling: standardised predictions, which a loss is taken of. The state is a
        dictionary of tensors; ``network.initial_state(batch, like=x)`` is that of a reset. It is the module that
        `predict` runs, so a change of its weights changes this predictor, but not its folder.
        """
        return self._bundle.predictor

    def evaluate(
        self,
        test: Recordings | Recording | Sequence[Recording] | None = None,
        baselines: Sequence[str] | None = None,
    ) -> JudgedScores:
        """Evaluate the predictor on recordings outside its training data.

        Baselines fitted to its training data are evaluated, too.

        Args:
            test: recordings, all of which are evaluated; without them those that the training set apart.
            baselines: names, such as ``persistence``, ``ridge_arx``; by default these two, and none for a bundle
                without its run folder, whose training data is not known.

        Raises:
            DataError: recordings that cannot be used, too short to be evaluated, or training data that changed.
            ConfigError: an unknown baseline, or what a bundle alone cannot give.
        """
        recordings = None if test is None else to_recordings(test)
        if not is_file_at(self.folder / PROVENANCE):
            return self._evaluate_bundle(recordings, baselines)
        source = None if recordings is None else recordings.source or _memory(recordings)
        names = BASELINES if baselines is None else tuple(baselines)
        return JudgedScores(read_facts(train_evaluate.evaluate(self.folder, source, names)))

    def predict(self, recordings: Recordings | Recording | Sequence[Recording]) -> Predictions:
        """Return the predictions at every tick of every recording, each from reset; targets need not be recorded.

        Raises:
            DataError: another rate, a missing input, or one that is not finite.
        """
        data = to_recordings(recordings)
        predictor = self._bundle.predictor
        series = [unlabelled(self._task, recording) for recording in data]
        # Bounds cost a second pass, which a point output does not need.
        bounds = stream_intervals(predictor, series) if predictor.output.coverages else None
        return Predictions(
            recordings=tuple(data),
            targets=self.targets,
            kinds=self._bundle.target_kinds,
            horizons=self.horizons,
            coverages=tuple(predictor.output.coverages),
            values=tuple(stream_predictions(predictor, series)),
            bounds=None if bounds is None else tuple(bounds),
        )

    def plot(self, test: Recordings | Recording | Sequence[Recording], horizon: int | None = None) -> Any:
        """Plot predictions for the first recording together with its measured values (Plotly).

        Args:
            test: recordings with the inputs.
            horizon: look-ahead in samples; the longest by default.

        Raises:
            DataError: see `predict`.
            ConfigError: no such horizon.
        """
        return self.predict(to_recordings(test)[:1]).plot(horizon=horizon)

    def export(self, target: str, folder: str | Path, name: str = "predictor", **options: object) -> list[Path]:
        """Write it in a form that runs without EDP.

        Args:
            target: ``c``, ``onnx``, ``simulink``, ``fmu``, ``casadi`` or ``ros2``.
            folder: output folder, which is created.
            name: name of the network in the exported files.
            options: options of the target (docs/howto/deploy_c.md).

        Returns:
            The files, the one to read first in front.

        Raises:
            ConfigError: an unknown target or option.
            ExportError: a network or a name that this form cannot hold.
        """
        return deployment.export_bundle(self.folder, target, folder, name, options)

    def stream(self) -> Stream:
        """Return a stream: ``step(row)`` takes one sample of `inputs` and returns prediction, intervals and status.

        What is learned on board (`edp adapt`) is part of it.
        """
        adaptation = self._bundle.adaptation
        if adaptation is not None:
            return AdaptedStream(self._bundle.predictor, adaptation)
        return Stream(self._bundle.predictor)

    def _evaluate_bundle(self, recordings: Recordings | None, baselines: Sequence[str] | None) -> JudgedScores:
        """Evaluate a bundle that has no run folder."""
        if recordings is None:
            raise ConfigError(f"'{self.folder}' is a bundle without its run folder; give the recordings to judge it on")
        if baselines:
            raise ConfigError(
                f"'{self.folder}' is a bundle without its run folder: the data to fit a baseline on is not known; "
                "leave baselines out, or load the run folder"
            )
        task, bundle = self._task, self._bundle
        data = Prepared(
            task=task,
            train=[],
            validation=[],
            test=[task.series(recording) for recording in recordings],
            inputs=bundle.inputs,
            feature_kinds=(),
            target_kinds=bundle.target_kinds,
            descriptions=bundle.descriptions,
            digest="",
        )
        judged = train_evaluate.judge_bundle(bundle, data, JudgeSpec(baselines=()))
        return JudgedScores(Facts(folder=self.folder, scores=judged.scores))

    def _table(self) -> Table:
        ahead = ", ".join(f"{k} ({typed(1000 * k / self.rate_hz)} ms)" for k in self.horizons)
        parameters = sum(parameter.numel() for parameter in self._bundle.predictor.parameters())
        rows = (
            ("Predicts", ", ".join(f"{name} [{self.units[name]}]" for name in self.targets)),
            ("Samples ahead", f"{ahead} at {typed(self.rate_hz)} Hz"),
            ("Reads", ", ".join(f"{name} [{self.units[name]}]" for name in self.inputs)),
            ("Parameters", f"{parameters:,}"),
            ("Folder", str(self.folder)),
        )
        return Table("Trained predictor", (Column(""), Column("")), rows)

    def __repr__(self) -> str:
        """Return a summary table as text."""
        return text_of(self._table())

    def _repr_html_(self) -> str:
        """Return a summary table as HTML for a notebook."""
        return html_of([self._table()])


def load(path: str | Path) -> TrainedPredictor:
    """Load a predictor from a run folder (written by `train` or `edp train`) or from a bundle.

    Raises:
        BundleError: neither of them, or a damaged one.
    """
    return TrainedPredictor(path)


def _memory(recordings: Recordings) -> MemorySource:
    # Named by content: the same recordings judged twice share a folder, others never overwrite it.
    """Return a data source of recordings in memory. Its folder name contains their digest."""
    content = "".join(f"{recording.name}\n{recording.digest}\n" for recording in recordings)
    digest = hashlib.blake2b(content.encode("utf-8", "surrogateescape"), digest_size=6).hexdigest()
    return MemorySource(Path(f"recordings-{digest}"), recordings=tuple(recordings))
