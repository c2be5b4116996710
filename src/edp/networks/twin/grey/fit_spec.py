"""Settings of the fit of a grey box to free runs."""

from __future__ import annotations

from dataclasses import dataclass

from edp.errors import ConfigError
from edp.settings.bounds import (
    MAX_BATCH,
    MAX_NAMES,
    MAX_UPDATES,
    SHARE,
    WEIGHT,
    above,
    check_bounds,
    check_count,
    integer,
)

MAX_STARTS = 100


@dataclass(frozen=True, kw_only=True)
class GreyFitSpec:
    """Settings for fitting the parameters of a grey box (`edp.training.grey_fit`).

    Attributes:
        lengths_s: lengths of the free runs, stage after stage.
        rounds: rounds of each stage; every one draws other segments.
        starts: number of starting points of the first stage; the one with the least validation error is used.
        steps: Gauss-Newton steps in a round.
        batch: free runs of a round at most.
        ticks: approximate total number of samples of the free runs in a round.
        memory: share of what a round knows that counts in the next one, beside its own segments.
        final_rounds: number of rounds after all stages, each with one step on free runs of the longest length; 0 for
            none.
        final_ticks: approximate total number of samples of the free runs in a final round.
        final_memory: share of what such a round knows that counts in the next one; less where the training part has
            fewer ticks than would count then.
        stroke_weight: weight of a standardised stroke error relative to velocities and pressures.
        delta: weighted error above which the Huber loss is linear, in standard deviations.
        validate_every: rounds from one validation to the next.
        validation_s: length of a free run of the validation.
        validation_runs: number of validation runs.

    Raises:
        ConfigError: a value out of range, or stages that do not fit one another.
    """

    lengths_s: tuple[float, ...] = (0.1, 0.3, 1.0, 3.0)
    rounds: tuple[int, ...] = (8, 6, 6, 4)
    starts: int = 3
    steps: int = 3
    batch: int = 512
    ticks: int = 12_000
    memory: float = 0.5
    final_rounds: int = 24
    final_ticks: int = 15_000
    final_memory: float = 0.9
    stroke_weight: float = 5.0
    delta: float = 0.2
    validate_every: int = 2
    validation_s: float = 10.0
    validation_runs: int = 32

    def __post_init__(self) -> None:
        length, count = above(0.0, 600.0), integer(1, MAX_UPDATES)
        bounds = {"lengths_s": length, "validation_s": length, "rounds": count, "steps": count, "ticks": count}
        bounds |= {"final_rounds": integer(0, MAX_UPDATES), "final_ticks": count, "final_memory": SHARE}
        bounds |= {
            "starts": integer(1, MAX_STARTS),
            "batch": integer(1, MAX_BATCH),
            "validation_runs": integer(1, MAX_BATCH),
            "validate_every": count,
        }
        check_bounds("grey box fit", self, stroke_weight=WEIGHT, delta=WEIGHT, memory=SHARE, **bounds)
        check_count("grey box fit", "lengths_s", self.lengths_s, MAX_NAMES, least=1)
        if len(self.lengths_s) != len(self.rounds):
            raise ConfigError(
                f"grey box fit: {len(self.lengths_s)} lengths_s and {len(self.rounds)} rounds; one number of rounds "
                "for each length must hold"
            )
