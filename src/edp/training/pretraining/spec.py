"""Settings of a pretraining over many machines."""

from __future__ import annotations

from dataclasses import dataclass

from edp.settings.bounds import MAX_BATCH, RATE, check_bounds, integer

MAX_STEPS = 1_000
"""Of adaptation: the gradient goes through all of them, and each keeps its copy of the weights."""


@dataclass(frozen=True, kw_only=True)
class MetaSpec:
    """Inner loop of the meta-learners; joint training over all machines does not use it.

    Attributes:
        inner_learning_rate: learning rate of a step of adaptation.
        inner_steps: steps of adaptation to a machine.
        shots: segments (``training.chunks.length``) of a machine that are adapted on, and as many that evaluate.
        head_only: adapt the head alone (ANIL, Raghu et al. 2020, arXiv 1909.09157).

    Raises:
        ConfigError: a value out of range.
    """

    inner_learning_rate: float = 0.5
    inner_steps: int = 3
    shots: int = 4
    head_only: bool = False

    def __post_init__(self) -> None:
        check_bounds(
            "pretraining",
            self,
            inner_learning_rate=RATE,
            inner_steps=integer(1, MAX_STEPS),
            shots=integer(1, MAX_BATCH),
        )

    @property
    def steps(self) -> tuple[float, ...]:
        """The rate of each step."""
        return (self.inner_learning_rate,) * self.inner_steps
