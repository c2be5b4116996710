"""A pretrained network as a candidate: one of other machines, trained on with the recordings at hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from edp.config.experiment import plain_tree
from edp.data.prepared import Prepared
from edp.errors import ConfigError
from edp.networks.backbones import CommitteeSpec
from edp.recording import Recording
from edp.settings.tree import Table
from edp.training.bundle import weights_digest
from edp.training.spec import TrainingSpec
from edp.training.strategy import TrainingStrategy
from edp.training.transfer.centring import Centred
from edp.training.transfer.checks import check_channels, check_lengths, check_signs, check_units
from edp.training.transfer.spec import FinetuneSpec
from edp.training.warm_start import WarmStart
from edp.workflows.transfer.case import tuned
from edp.workflows.transfer.source import SourceModel, read_source

SETTING = "auto.foundation"
LEAST_UPDATES = 120
"""Of a fine-tuning, where ten passes over the recordings are fewer: those of the measured ones (docs/results.md)."""


@dataclass(frozen=True, eq=False)
class Foundation:
    """A network to begin with, as ``auto.foundation`` names it.

    Attributes:
        path: as the settings have it.
        source: the network and the settings of its run.
    """

    path: str
    source: SourceModel

    @property
    def window(self) -> int:
        """W of the network, which every candidate then has: all are cut from the recordings in the same way."""
        return self.source.predictor.spec.window

    @property
    def facts(self) -> Table:
        """What identifies it."""
        return {"weights": weights_digest(self.source.predictor)}

    @property
    def weights(self) -> int:
        """Parameters, which a tick of training passes through."""
        return sum(parameter.numel() for parameter in self.source.predictor.parameters())

    @property
    def ticks(self) -> int:
        """Of an update, all lanes together."""
        chunks = self._training(0, 1).chunks
        return chunks.length * chunks.batch

    def check_recordings(self, recordings: Sequence[Recording]) -> None:
        """Refuse recordings without the channels, or of another rate, than the network's.

        Raises:
            DataError: which channels of which recordings, and what to do.
        """
        check_channels(recordings, self.source.bundle.task)

    def check_task(self, data: Prepared) -> None:
        """Refuse a task other than the network's, and recordings that it cannot be trained on with.

        Raises:
            ConfigError: every part of the task that differs.
            DataError: recordings that are too short, in other units or of another sign convention.
        """
        own, asked = self.source.bundle.task, data.task
        pairs = {
            "targets": (own.targets, asked.targets),
            "horizons": (own.horizons, asked.horizons),
            "mode": (own.mode, asked.mode),
            "features": (own.features.features, asked.features.features),
        }
        other = [f"{name} {its}, the settings {here}" for name, (its, here) in pairs.items() if its != here]
        if not other and own != asked:
            other = ["derived targets or hidden channels that the settings do not have"]
        if other:
            raise ConfigError(
                f"{SETTING}: the network of '{self.path}' has {'; '.join(other)}; these must be equal: change [task], "
                "pretrain with this task, or leave the setting out"
            )
        check_lengths(data, self._training(0, 1).chunks, self.window)
        check_units(data, self.source.predictor.front)
        check_signs(data, None)

    def tables(self, rows: int, affordable: float, seed: int, threads: int) -> Table:
        """The tables ``model`` and ``training`` of the candidate.

        Args:
            rows: ticks to train on.
            affordable: updates that the budget allows.
            seed: of all random choices.
            threads: CPU threads.
        """
        rounds = FinetuneSpec().rounds
        updates = int(min(affordable, max(LEAST_UPDATES, rounds * rows / self.ticks))) // rounds
        training = replace(self._training(max(1, updates), threads), seed=seed)
        experiment = replace(self.source.experiment, model=self.source.predictor.spec, training=training)
        return {part: plain_tree(experiment)[part] for part in ("model", "training")}

    def _training(self, updates: int, threads: int) -> TrainingSpec:
        """As `edp finetune --method full` trains, so many updates an epoch."""
        own = tuned(self.source.experiment.training, FinetuneSpec())
        return replace(own, updates=updates, threads=threads, bagging=None)

    def strategy(self) -> TrainingStrategy:
        """Weights to begin with; the mean error over the training part is taken out at the end."""
        return Centred(WarmStart(self.source.predictor))


def read_foundation(path: str) -> Foundation | None:
    """The network that the settings name; None where they name none.

    Raises:
        ConfigError: a committee, whose parts do not learn by gradient.
        EdpError: no run or bundle in float32 is there.
    """
    if not path:
        return None
    foundation = Foundation(path, read_source(path, recordings=False))
    if isinstance(foundation.source.predictor.spec.backbone, CommitteeSpec):
        raise ConfigError(
            f"{SETTING}: '{path}' is a committee, which the preset makes of the recordings itself; give a network that "
            "was trained by gradient, such as a run of edp pretrain, or leave the setting out"
        )
    return foundation
