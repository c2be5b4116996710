"""Conversion of events of a training to steps of `edp.progress.Progress`."""

from __future__ import annotations

from collections.abc import Callable

from edp.progress import Progress
from edp.training.fitted_twin import FreeRunProgress
from edp.training.outcome import TrainingProgress


def free_run_steps(progress: Progress) -> Callable[[FreeRunProgress], None]:
    """Return a listener of trainings on free runs that reports each event as a step.

    Args:
        progress: stage that the trainings belong to.
    """

    def report(event: FreeRunProgress) -> None:
        # A fit that goes on beyond its plan has no time left to state.
        left = 0.0 if event.update >= event.updates else event.seconds_left
        error = {} if event.validation is None else {"free_run_error": event.validation}
        progress.stage("update", event.updates).step(event.update, seconds_left=left, length_s=event.length_s, **error)

    return report


def training_steps(progress: Progress) -> Callable[[TrainingProgress], None]:
    """Return a training listener that reports each event as a step, with the best validation error until now.

    Args:
        progress: stage that the training belongs to.
    """
    best: dict[str, float] = {}

    def report(event: TrainingProgress) -> None:
        if event.row is not None and event.row["best"]:
            best["validation_mae"] = event.row["validation_mae"]
        epochs = progress.stage("refit, epoch" if event.refit else "epoch", event.epochs)
        speed, left = event.targets_per_s, event.seconds_left
        epochs.step(event.epoch, share=event.share, seconds_left=left, targets_per_s=speed, **best)

    return report
