"""Recordings through a network and its adaptation, tick by tick, as they would have been on board."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.task import Task
from edp.errors import BundleError, DataError
from edp.evaluation.adaptation_file import AdaptationFile, ReplayErrors, ReplayTarget
from edp.ir.rls import Adaptation, RlsCorrector, RlsState, RlsStatus
from edp.logs.source import DataSource
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.progress import SILENT, Progress
from edp.signals import KINDS, Kind
from edp.training import load_bundle
from edp.training.twin_bundle import load_twin
from edp.workflows.adaptation.with_twin import TwinMoves, choose_tuned_spec, correction_of

# 60 s are the usual forgetting time: beyond it the adaptation is settled.
BINS = (0.0, 10.0, 30.0, 60.0)
"""Seconds of motion from which errors are gathered, each up to the next."""
Rows = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Replayed:
    """One recording.

    Attributes:
        name: name of the recording.
        base: predictions of the network ``(time, horizon, target)``, SI units.
        adapted: corrected predictions, same shape.
        motion_s: seconds of motion before each tick ``(time,)``.
        status: status of the adaptation at each sample ``(time,)``.
        targets: measured targets ``(time, target)``, SI units.
    """

    name: str
    base: Rows
    adapted: Rows
    motion_s: NDArray[np.float64]
    status: NDArray[np.int64]
    targets: Rows


@dataclass(frozen=True, eq=False)
class Replay:
    """Recordings with the errors that count: ticks behind a whole window whose truth is known.

    Attributes:
        recordings: each of them.
        horizons: ticks ahead.
        skip: ticks of the start that do not count.
        learned: learned correction at the end.
    """

    recordings: list[Replayed]
    horizons: tuple[int, ...]
    skip: int
    learned: RlsState

    def errors(self, of: str, horizon: int) -> list[tuple[Rows, NDArray[np.float64]]]:
        """Return absolute errors ``(tick, target)`` of ``base`` or ``adapted``.

        With the seconds of motion before each.
        """
        horizon_index, errors = self.horizons.index(horizon), []
        for part in self.recordings:
            predictions = getattr(part, of)[self.skip : len(part.targets) - horizon, horizon_index]
            error = np.abs(predictions - part.targets[self.skip + horizon :])
            errors.append((error, part.motion_s[self.skip : len(part.targets) - horizon]))
        return errors

    def mae(self, of: str, horizon: int, low: float = 0.0, high: float = np.inf) -> NDArray[np.float64] | None:
        """Return the MAE of each target ``(target,)`` from `low` to `high` seconds of motion, SI units.

        None without ticks.
        """
        selected = [error[(at >= low) & (at < high)] for error, at in self.errors(of, horizon)]
        rows = np.concatenate(selected)
        return rows.mean(axis=0, dtype=np.float64) if len(rows) else None

    def errors_by_target(self, parts: Sequence[Replayed]) -> NDArray[np.float64]:
        """Return the MAE of each horizon and target without and with adaptation, shape (2, horizon * target)."""
        some = replace(self, recordings=list(parts))
        rows = [(some.mae("base", k), some.mae("adapted", k)) for k in self.horizons]
        pairs = [(base, adapted) for base, adapted in rows if base is not None and adapted is not None]
        return np.concatenate(pairs, axis=1) if pairs else np.empty((2, 0))

    def content(self, task: Task, kinds: Sequence[Kind]) -> AdaptationFile:
        """Return the errors of `task`, whose targets are of these kinds, by horizon and time in motion."""
        facts = [KINDS[kind] for kind in kinds]
        factors = np.array([fact.report_factor for fact in facts])
        rows = []
        for k in self.horizons:
            for low, high in zip(BINS, [*BINS[1:], np.inf], strict=True):
                base, adapted = (self.mae(of, k, low, high) for of in ("base", "adapted"))
                if base is not None and adapted is not None:
                    rows.append(ReplayErrors(
                        horizon=k, from_s=low, to_s=None if np.isinf(high) else high,
                        base=tuple((base * factors).tolist()), adapted=tuple((adapted * factors).tolist()),
                    ))  # fmt: skip
        status = np.concatenate([part.status for part in self.recordings])
        return AdaptationFile(
            recordings=tuple(part.name for part in self.recordings),
            targets=tuple(ReplayTarget(name=n, unit=f.report_unit) for n, f in zip(task.targets, facts, strict=True)),
            mae=tuple(rows),
            change=relative_change(self.errors_by_target(self.recordings)),
            change_by_recording={part.name: relative_change(self.errors_by_target([part])) for part in self.recordings},
            fallback=float((status == RlsStatus.FALLBACK).mean()),
            taught=int((status == RlsStatus.LEARNING).sum()),
        )


def relative_change(errors: NDArray[np.float64]) -> float:
    """Return the geometric mean of the ratios of adapted to plain errors, less one; 0 without comparable errors.

    Args:
        errors: shape (2, n), without and with adaptation.
    """
    positive = errors[:, (errors > 0.0).all(axis=0)]
    return float(np.expm1(np.log(positive[1] / positive[0]).mean())) if positive.size else 0.0


def motion_s(adaptation: Adaptation, targets: Rows) -> NDArray[np.float64]:
    """Return the seconds of motion before each tick ``(time,)``, as the adaptation counts motion."""
    moving = (np.abs(targets - adaptation.middle) > adaptation.dead_zone).any(axis=1)
    return np.concatenate([[0.0], np.cumsum(moving)[:-1]]) / adaptation.rate_hz


def replay(
    predictor: Predictor,
    adaptation: Adaptation,
    series: Sequence[Series],
    carry: bool = False,
    learn: bool = True,
    progress: Progress = SILENT,
    moves: Callable[[Sequence[Rows]], Sequence[Rows]] | None = None,
) -> Replay:
    """Run recordings one after the other through a network and its adaptation.

    Args:
        predictor: the network; it starts again with each recording.
        adaptation: settings of the correction.
        series: the recordings.
        carry: keep what was learned from one recording to the next, as on one machine; else each starts from nothing.
        learn: False freezes the adaptation.
        progress: receiver of the progress; its units are recordings.
        moves: function that changes the network's predictions ``(time, horizon, target)`` of the recordings before the
            adaptation corrects them; None for no change.

    Raises:
        DataError: no recording is longer than start-up and horizon.
    """
    skip = predictor.spec.window
    if not any(part.samples > skip + adaptation.max_horizon for part in series):
        raise DataError(
            f"no recording is longer than {skip + adaptation.max_horizon} ticks, which start-up and horizon "
            "take; give longer"
        )
    adapter, replayed = RlsCorrector(adaptation), []
    plain = stream_predictions(predictor, series)
    moved = plain if moves is None else moves(plain)
    recordings = progress.stage("recording", len(series))
    for number, (part, base, start) in enumerate(zip(series, plain, moved, strict=True)):
        recordings.note(part.name)
        # The gap between recordings is no motion: predictions from before it must not be judged after it.
        adapter.interrupt()
        if not carry:
            adapter.reset()
        adapted, status = np.empty_like(base), np.zeros(len(base), dtype=np.int64)
        for tick, (x, y) in enumerate(zip(part.inputs, start, strict=True)):
            # Before a whole window the network itself is not warm; its errors would teach the wrong thing.
            adapted[tick], status[tick] = adapter.step(x, y, fresh=tick + 1 >= skip, learn=learn)
        replayed.append(Replayed(part.name, base, adapted, motion_s(adaptation, part.targets), status, part.targets))
        recordings.step(number + 1)
    return Replay(replayed, adaptation.horizons, skip, adapter.learned)


def replay_run(
    run: str | Path,
    source: DataSource,
    carry: bool = False,
    learn: bool = True,
    progress: Progress = SILENT,
    twin: str | Path | None = None,
) -> AdaptationFile:
    """Replay logs through a run that `edp adapt` wrote; see `replay`.

    Args:
        run: run with an adaptation.
        source: the logs.
        carry: keep what was learned from one recording to the next.
        learn: False freezes what was learned.
        progress: receiver of the progress; its units are recordings.
        twin: run folder of a grey box of the machine as it was, whose numbers follow the machine and towards which the
            network's predictions move before they are corrected (`edp.networks.twin.adaptive_correction`); None: none.

    Raises:
        EdpError: a run without adaptation, logs that do not go with its network, or a twin that does not.
    """
    bundle = load_bundle(run)
    if bundle.adaptation is None:
        raise BundleError(f"'{run}' has no adaptation; edp adapt {run} --out FOLDER makes a run that has one")
    recordings = source.read()
    series = [bundle.task.series(recording) for recording in recordings]
    moves = None
    if twin is not None:
        grey = load_twin(twin)
        by_twin = TwinMoves(
            grey.twin, correction_of(grey.twin, bundle.adaptation, bundle.task, choose_tuned_spec(grey))
        )
        moves = partial(by_twin, recordings, carry=carry, learn=learn)
    result = replay(bundle.predictor, bundle.adaptation, series, carry, learn, progress, moves)
    return result.content(bundle.task, bundle.target_kinds)
