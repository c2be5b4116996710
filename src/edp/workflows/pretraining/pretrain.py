"""One network for many machines: trained on some, selected on others, evaluated on unseen ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from edp import __version__
from edp.config.experiment import Experiment, plain_tree
from edp.data.episodes import group_by_machine
from edp.data.prepared import Prepared
from edp.data.splits import ByMachine
from edp.errors import BundleError, ConfigError
from edp.evaluation.context import Contexts, context_errors
from edp.evaluation.foundation_file import FoundationFile, PartSize
from edp.jobs import IN_PROCESS, Workers
from edp.jobs.workers import WorkUnit
from edp.logs.source import DataSource
from edp.networks.predictor import Predictor
from edp.progress import SILENT, Progress
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path
from edp.storage.runs import Run, check_claimable, check_visible
from edp.training import Diverged, load_bundle
from edp.training.bundle import weights_digest
from edp.training.pretraining.methods import PRETRAININGS
from edp.training.pretraining.methods.base import HasModel
from edp.training.pretraining.spec import MetaSpec
from edp.training.progress_steps import training_steps
from edp.workflows.train_evaluate import StrategyFactory, prepare_data, train

CARRIED_S = 60.0
"""Default length of carried streams in joint training, because identification takes time."""


@dataclass(frozen=True, kw_only=True)
class Pretrain:
    """Training of one network for many machines.

    Attributes:
        method: name of a registered method.
        meta: the inner loop, of methods that have one.
        start: run folder or bundle to begin with; None begins at random.

    Raises:
        ConfigError: an unknown method.
    """

    method: str = "joint"
    meta: MetaSpec = field(default_factory=MetaSpec)
    start: str | Path | None = None

    def __post_init__(self) -> None:
        # An unknown method fails before hours of reading.
        _ = PRETRAININGS[self.method]


def pretrain(
    source: DataSource,
    experiment: Experiment,
    order: Pretrain,
    out: str | Path,
    progress: Progress = SILENT,
    workers: Workers = IN_PROCESS,
) -> FoundationFile:
    """Train one network for many machines and evaluate it on others; a stopped training continues.

    What comes out is a run like any other, with ``foundation.json`` beside it.

    Args:
        source: recordings that know their machine.
        experiment: the settings, with a split by machine.
        order: the method.
        out: run folder.
        progress: receiver of the progress; the units of the training are epochs.
        workers: who trains; a node of a cluster sees recordings and run folder under the same paths.

    Returns:
        The content of ``foundation.json``: machines of each part and errors by context on those that test.

    Raises:
        EdpError: recordings without machine, too few machines, or settings that do not go with the method.
        Diverged: the loss was not finite any more.
    """
    check_claimable(out, "pretraining")
    if workers.cluster:
        _pretrain_on_node(source, experiment, order, Path(out), workers)
    if not isinstance(experiment.split, ByMachine):
        # Other splits leave recordings of a machine on both sides, and the network would know the machines that judge
        # it.
        raise ConfigError(
            "pretraining holds out whole machines, but the settings divide the recordings otherwise; set "
            'split.kind = "machines"'
        )
    method = PRETRAININGS[order.method]()
    if isinstance(method, HasModel):
        experiment = replace(experiment, model=method.model(experiment.model))
    begun, frozen = (None, {}) if order.start is None else _start(order.start)
    strategy = method.strategy(order.meta, begun)
    data = prepare_data(source, experiment, frozen)
    experiment = _carrying(experiment, method.episodic, data.task.rate_hz)
    strategy_factory = None
    if strategy is not None:
        facts: dict[str, object] = {"method": order.method, "start": None if begun is None else weights_digest(begun)}
        facts |= {"meta": asdict(order.meta)} if method.episodic else {}
        chosen = strategy
        strategy_factory = StrategyFactory(facts, lambda prepared: chosen, frozen)
    with Run(out, "pretraining") as run:
        network = train(source, experiment, run, training_steps(progress), strategy_factory, data).predictor
        progress.note("judging on machines that were never seen")
        contexts = context_errors(network, data.test, data.target_kinds)
        result = _result(order, experiment, data, contexts)
        result.write(run.path)
        run.finish()
    return result


def _pretrain_on_node(source: DataSource, experiment: Experiment, order: Pretrain, out: Path, workers: Workers) -> None:
    """Train on a node of a cluster, into the run folder.

    Raises:
        ConfigError: the run folder is not there afterwards.
    """
    arguments = {"experiment": plain_tree(experiment), "method": order.method, "meta": asdict(order.meta)}
    start = None if order.start is None else full_path(Path(order.start))
    where = {
        "source": source.visible_to(workers),
        "experiment": experiment,
        "order": replace(order, start=start),
        "out": str(full_path(out)),
    }
    unit = WorkUnit(f"{__name__}:pretrain_unit", f"pretraining in '{out}'", arguments, source.content_key(), where)
    for _ in workers.map([unit]):
        check_visible(out)


def pretrain_unit(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, str]:
    """Train one network for many machines, or continue; the folder records a diverged run."""
    try:
        pretrain(where["source"], where["experiment"], where["order"], where["out"])
    except Diverged as end:
        return {"diverged": str(end)}
    return {}


def _start(path: str | Path) -> tuple[Predictor, dict[str, str]]:
    """Return a start network, and the names by digest of its frozen sessions.

    Raises:
        BundleError: not a bundle, or one of an integer network (W8A16).
    """
    bundle = load_bundle(path)
    predictor = bundle.predictor
    if predictor.number_format != "float32":
        raise BundleError(f"'{path}' is a network in {predictor.number_format}, which cannot be trained on")
    return predictor, dict(bundle.provenance.origin.frozen)


def _carrying(experiment: Experiment, episodic: bool, rate_hz: float) -> Experiment:
    """Return the settings with streams that continue for a minute, for chunk training without this setting."""
    chunks = experiment.training.chunks
    if episodic or chunks.reset_after_chunks or chunks.regime == "window":
        return experiment
    # At least one chunk, however long chunks are.
    carried = max(1, round(CARRIED_S * rate_hz / chunks.length))
    return replace(
        experiment, training=replace(experiment.training, chunks=replace(chunks, reset_after_chunks=carried))
    )


def _result(order: Pretrain, experiment: Experiment, data: Prepared, contexts: Contexts) -> FoundationFile:
    parts = {part: group_by_machine(getattr(data, part)) for part in ("train", "validation", "test")}
    return FoundationFile(
        edp=__version__,
        method=order.method,
        label=PRETRAININGS[order.method].label,
        meta=asdict(order.meta) if PRETRAININGS[order.method].episodic else None,
        horizon=data.task.horizons[0],
        rate_hz=data.task.rate_hz,
        carried=experiment.training.chunks.reset_after_chunks,
        data={
            part: PartSize(
                machines=len(owned),
                recordings=len(getattr(data, part)),
                minutes=round(sum(s.samples for s in getattr(data, part)) / data.task.rate_hz / 60, 2),
            )
            for part, owned in parts.items()
        },
        unseen=contexts.unseen_errors(),
    )
