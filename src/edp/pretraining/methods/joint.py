"""Joint training: all machines alike, states carried for long, so that the network identifies a machine as it runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from torch import Tensor

from edp.compress.distillation import continue_from
from edp.data.series import Series
from edp.data.task import Task
from edp.models.predictor import Predictor
from edp.pretraining.methods.base import PRETRAININGS
from edp.pretraining.spec import MetaSpec
from edp.training.lesson import Lesson, Moment
from edp.training.objective import Objective
from edp.training.spec import TrainingSpec


@PRETRAININGS.register("joint")
class Joint:
    """Minimise the mean error over all machines."""

    label: ClassVar[str] = "Joint"
    episodic: ClassVar[bool] = False

    def lesson(self, spec: MetaSpec, start: Predictor | None) -> Lesson | None:
        """The start, where there is one."""
        return None if start is None else _From(start)


class _From:
    """A lesson that begins with the weights of another network."""

    def __init__(self, start: Predictor) -> None:
        self.start = start

    def series(self, task: Task, known: Sequence[Series]) -> list[Series]:
        return list(known)

    def begin(self, net: Predictor, spec: TrainingSpec) -> bool:
        continue_from(net, self.start)
        return True

    def loss(self, objective: Objective, moment: Moment) -> Tensor:
        return objective.evaluate(moment.answer, moment.future, moment.features, moment.valid)

    def end(self, net: Predictor) -> None:
        """Nothing was done to the network beside its weights."""
