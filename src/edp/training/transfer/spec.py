"""Settings of a fine-tuning; the two phases have the values of the thesis (Table 3.1 and 3.4.5)."""

from __future__ import annotations

from dataclasses import dataclass

from edp.settings.bounds import (
    DECAY,
    MAX_BATCH,
    MAX_EPOCHS,
    MAX_UNITS,
    RATE,
    WEIGHT,
    above,
    check_bounds,
    integer,
    span,
)

MAX_STEPS = 10_000
"""Of the method of few steps, each over all the logs."""


@dataclass(frozen=True, kw_only=True)
class FinetuneSpec:
    """Phases, rates and regularisers of a fine-tuning.

    Attributes:
        head_epochs: number of epochs of phase 1, which trains only the head.
        epochs: number of epochs of phase 2, which trains the whole network.
        head_learning_rate: learning rate of the head, in both phases.
        backbone_learning_rate: learning rate of the backbone in phase 2.
        depth_decay: rate of a part of the backbone over that of the part above it; 1 for one rate.
        single_phase_epochs: epochs of methods without phases.
        learning_rate: learning rate of methods without phases, which learn with SOAP.
        batch: lanes of a chunk, or windows, of an update.
        smoothness: weight of the second difference of consecutive predictions; 0 for none.
        weight_decay: lambda of AdamW and SOAP.
        patience: epochs without a better validation score before a phase ends; 0 never ends early.
        rank: rank of the low-rank adapters.
        source_weight: weight of the source's loss relative to the target's, for methods with rehearsal.
        distillation_fraction: share of that loss that compares with what the source's network says, of the method that
            distils.
        adversarial_weight: weight of the reversed gradient of the classifier of domains, of the adversarial method.
        inner_learning_rate: learning rate of the method of few steps; 0 for that of the source's meta-learning, or 0.5.
        inner_steps: most steps of that method.
        center: take the mean error over the logs that train out of the network that comes out.
        check_signs: refuse logs in which a target moves against the pilot pressures that moved it in the source.

    Raises:
        ConfigError: a value out of range.
    """

    # Epochs and rates of the two phases are those of the thesis's Table 3.1.
    head_epochs: int = 15
    epochs: int = 25
    head_learning_rate: float = 3e-4
    backbone_learning_rate: float = 1e-5
    depth_decay: float = 1.0
    # Ten rounds at 3e-3: rates hardly matter here, and the best epoch comes early (docs/journal, fine-tuning to
    # C14).
    single_phase_epochs: int = 10
    learning_rate: float = 3e-3
    batch: int = 32
    smoothness: float = 0.05
    weight_decay: float = 1e-4
    patience: int = 8
    rank: int = 8
    source_weight: float = 1.0
    distillation_fraction: float = 0.5
    adversarial_weight: float = 0.1
    inner_learning_rate: float = 0.0
    inner_steps: int = 30
    # The mean error after a nearly linear loss is worth removing (docs/journal, `center`).
    center: bool = True
    check_signs: bool = True

    def __post_init__(self) -> None:
        check_bounds(
            "finetune",
            self,
            **dict.fromkeys(("head_epochs", "epochs", "single_phase_epochs"), integer(1, MAX_EPOCHS)),
            **dict.fromkeys(("head_learning_rate", "backbone_learning_rate", "learning_rate"), RATE),
            **dict.fromkeys(("smoothness", "weight_decay"), DECAY),
            **dict.fromkeys(("source_weight", "adversarial_weight"), WEIGHT),
            depth_decay=above(0.0, 1.0),
            distillation_fraction=above(0.0, 1.0),
            batch=integer(1, MAX_BATCH),
            patience=integer(0, MAX_EPOCHS),
            rank=integer(1, MAX_UNITS),
            inner_learning_rate=span(0.0, RATE.high),
            inner_steps=integer(1, MAX_STEPS),
        )
