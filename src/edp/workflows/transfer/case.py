"""One transfer: a source, the logs of a target, and the trainings that methods request."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from edp.config.experiment import Experiment
from edp.data.chunks import ChunkSpec
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.logs.source import DataSource
from edp.networks.losses import Smoothness
from edp.networks.predictor import Predictor
from edp.progress import SILENT, Progress
from edp.storage.runs import Run
from edp.training.optimizers import OptimizerSpec, Soap
from edp.training.progress_steps import training_steps
from edp.training.spec import TrainingSpec
from edp.training.strategy import TrainingStrategy
from edp.training.transfer.centring import Centred
from edp.training.transfer.spec import FinetuneSpec
from edp.workflows.train_evaluate import StrategyFactory, train
from edp.workflows.transfer.source import SourceModel

NEIGHBOURS = 4
"""Windows drawn together, so that smoothness can compare neighbours; divides the usual batches."""


@dataclass(frozen=True, eq=False)
class TransferCase:
    """Inputs of a method.

    Attributes:
        source: the network of another machine.
        logs: source of the recordings of the target machine.
        data: recordings of the target machine, divided by time.
        experiment: settings of the source with the target's split.
        spec: phases, rates and regularisers.
        folder: folder of the method's run, or the opened run.
        progress: receiver of the progress of its trainings.
    """

    source: SourceModel
    logs: DataSource
    data: Prepared
    experiment: Experiment
    spec: FinetuneSpec
    folder: Path | Run
    progress: Progress = SILENT

    def train(
        self,
        name: str,
        training: TrainingSpec,
        strategy: Callable[[], TrainingStrategy] | None,
        facts: Mapping[str, object] | None = None,
        phase: str = "",
        judged: Sequence[Series] = (),
        centred: bool = True,
    ) -> Predictor:
        """Train in the method's folder, or for a phase in a subfolder; a stopped training continues.

        Args:
            name: name in the progress.
            training: settings of the training.
            strategy: makes what the training begins with; None begins at random.
            facts: plain values that decide the strategy beside the source.
            phase: name of a phase that a later one goes on from.
            judged: further series that choose the best epoch.
            centred: whether the mean error over the target's logs may be taken out at the end, if the specs ask for it.
        """
        strategy_factory = None
        if strategy is not None:
            make, training_facts = strategy, {"method": name, "source": self.source.facts, **(facts or {})}
            if centred and self.spec.center and not phase:
                # A phase is not centred: only the last one leaves a network.
                strategy_factory = StrategyFactory(
                    {**training_facts, "centred": True}, lambda data: Centred(make()), self.source.frozen
                )
            else:
                strategy_factory = StrategyFactory(training_facts, lambda data: make(), self.source.frozen)
        experiment = replace(self.experiment, training=training)
        own = self.folder.path if isinstance(self.folder, Run) else self.folder
        folder = own / "phases" / phase if phase else self.folder
        progress = self.progress.stage(phase) if phase else self.progress
        # The source's validation part counts too where both domains are to be kept.
        data = replace(self.data, validation=[*self.data.validation, *judged])
        return train(self.logs, experiment, folder, training_steps(progress), strategy_factory, data).predictor

    def tuning(self, optimizer: OptimizerSpec | None = None, epochs: int | None = None) -> TrainingSpec:
        """Return the settings of fine-tuning, see `tuned`."""
        return tuned(self.experiment.training, self.spec, optimizer, epochs)


def tuned(
    training: TrainingSpec, spec: FinetuneSpec, optimizer: OptimizerSpec | None = None, epochs: int | None = None
) -> TrainingSpec:
    """Return the settings of fine-tuning: small batches, light smoothness, early stopping (thesis 3.4.5).

    Args:
        training: settings of the source's training.
        spec: settings of the fine-tuning.
        optimizer: optimiser; SOAP with one rate for all parameters by default.
        epochs: number of epochs; by default that of methods without phases.
    """
    # The source's own smoothness is replaced by that of the fine-tuning.
    terms = tuple(term for term in training.terms if not isinstance(term, Smoothness))
    if spec.smoothness:
        smooth: Any = Smoothness(weight=spec.smoothness)
        terms = (*terms, smooth)
    chunks = replace(training.chunks, batch=spec.batch, consecutive=1)
    if chunks.regime == "window":
        # Neighbouring windows must divide the batch.
        near = NEIGHBOURS if spec.batch % NEIGHBOURS == 0 else spec.batch
        chunks = replace(chunks, consecutive=near if terms else 1)
    else:
        chunks = repeat_chunks(chunks)
    return replace(
        training,
        chunks=chunks,
        terms=terms,
        optimizer=optimizer or Soap(learning_rate=spec.learning_rate, weight_decay=spec.weight_decay),
        epochs=epochs or spec.single_phase_epochs,
        patience=spec.patience,
        refit="none",
    )


def repeat_chunks(chunks: ChunkSpec) -> ChunkSpec:
    """Return chunk settings that read minutes of logs repeatedly with different cuts."""
    if chunks.reset_after_chunks or chunks.regime == "window":
        return chunks
    # A piece must be longer than its burn-in; eight chunks leave most of its ticks with a loss.
    return replace(chunks, reset_after_chunks=max(8, chunks.burn_in // chunks.length + 1))
