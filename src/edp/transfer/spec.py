"""What is set of a fine-tuning; the two phases have the values of the thesis (Table 3.1 and 3.4.5)."""

from __future__ import annotations

from dataclasses import dataclass

from edp.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class FinetuneSpec:
    """Phases, rates and regularisers of a fine-tuning.

    Attributes:
        head_epochs: of phase 1, in which only the head learns.
        epochs: of phase 2, in which everything learns.
        head_rate: learning rate of the head, in both phases.
        backbone_rate: learning rate of the backbone in phase 2.
        depth_decay: rate of a part of the backbone over that of the part above it; 1 for one rate.
        rounds: epochs of methods without phases.
        rate: learning rate of methods without phases, which learn with SOAP.
        batch: lanes of a chunk, or windows, of an update.
        smoothness: weight of the second difference of consecutive predictions; 0 for none.
        weight_decay: lambda of AdamW and SOAP.
        patience: epochs without a better validation score before a phase ends; 0 never ends early.
        rank: of the low-rank adapters.
        source_weight: of the source's loss beside the target's, of methods that replay it.
        soft: share of that loss that compares with what the source's network says, of the method that distils.
        reversal: weight of the reversed gradient of the classifier of worlds, of the adversarial method.
        inner_rate: learning rate of the method of few steps; 0 for that of the source's meta-learning, or 0.5.
        inner_steps: most steps of that method.
        center: take the mean error over the logs that train out of the network that comes out.
        check_signs: refuse logs in which a target moves against the pilot pressures that moved it in the source.

    Raises:
        ConfigError: a value out of range.
    """

    head_epochs: int = 15
    epochs: int = 25
    head_rate: float = 3e-4
    backbone_rate: float = 1e-5
    depth_decay: float = 1.0
    rounds: int = 10
    rate: float = 3e-3
    batch: int = 32
    smoothness: float = 0.05
    weight_decay: float = 1e-4
    patience: int = 8
    rank: int = 8
    source_weight: float = 1.0
    soft: float = 0.5
    reversal: float = 0.1
    inner_rate: float = 0.0
    inner_steps: int = 30
    center: bool = True
    check_signs: bool = True

    def __post_init__(self) -> None:
        if min(self.head_epochs, self.epochs, self.rounds, self.batch, self.rank) < 1 or self.patience < 0:
            raise ConfigError(
                f"finetune: head_epochs = {self.head_epochs}, epochs = {self.epochs}, rounds = {self.rounds}, batch = "
                f"{self.batch}, rank = {self.rank}, patience = {self.patience}; at least 1, and a patience of at "
                "least 0, must hold"
            )
        if not min(self.head_rate, self.backbone_rate, self.rate) > 0 or not 0 < self.depth_decay <= 1:
            raise ConfigError(
                f"finetune: head_rate = {self.head_rate}, backbone_rate = {self.backbone_rate}, rate = {self.rate}, "
                f"depth_decay = {self.depth_decay}; rates > 0 and 0 < depth_decay <= 1 must hold"
            )
        if self.inner_rate < 0 or self.inner_steps < 1:
            raise ConfigError(
                f"finetune: inner_rate = {self.inner_rate}, inner_steps = {self.inner_steps}; a rate of at least 0 and "
                "at least one step must hold"
            )
        if not self.source_weight > 0 or not 0 < self.soft <= 1 or not self.reversal > 0:
            raise ConfigError(
                f"finetune: source_weight = {self.source_weight}, soft = {self.soft}, reversal = {self.reversal}; "
                "source_weight > 0, 0 < soft <= 1 and reversal > 0 must hold"
            )
        if min(self.smoothness, self.weight_decay) < 0:
            raise ConfigError(
                f"finetune: smoothness = {self.smoothness}, weight_decay = {self.weight_decay}; at least 0 must hold"
            )
