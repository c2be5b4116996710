"""`edp pretrain` and `edp finetune` by a pool or a cluster: a unit a training, which goes on in its run folder.

A training whose process or node is killed goes on from its last checkpoint, since the folder is on a disk that all see.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edp.config.experiment import Experiment, build, plain_tree
from edp.errors import ConfigError
from edp.evaluation.transfer_file import TransferFile
from edp.jobs import Workforce
from edp.jobs.units import UnitResult, WorkUnit, run_units
from edp.logs.source import DataSource
from edp.progress import SILENT, Progress
from edp.storage.ledger import TrainingIdentity
from edp.storage.paths import full_path, is_file_at
from edp.training import Diverged
from edp.workflows.fleet.storing import keys_of
from edp.workflows.pretraining import MetaSpec, Pretrain, pretrain
from edp.workflows.transfer import FinetuneRequest, FinetuneSpec, finetune
from edp.workflows.transfer.finetune import train_method, trained_methods

DIVERGED = "diverged"


def pretrain_with(
    workforce: Workforce, source: DataSource, experiment: Experiment, order: Pretrain, out: str | Path
) -> dict[str, Any]:
    """As `edp.workflows.pretraining.pretrain`, in a process or on a node of a workforce.

    Args:
        workforce: who trains; nodes see recordings and run folder under the same paths.
        source: recordings that know their machine.
        experiment: the settings.
        order: the method.
        out: run folder; what was trained in it goes on.

    Raises:
        EdpError: as `pretrain`; `UnitError` from elsewhere.
        Diverged: the loss was not finite any more.
    """
    arguments = {"experiment": plain_tree(experiment), "method": order.method, "meta": asdict(order.meta)}
    where = {
        "source": source.to_plain(),
        "out": str(full_path(Path(out))),
        "begun_from": None if order.start is None else str(full_path(Path(order.start))),
    }
    unit = WorkUnit(f"{__name__}:pretrain_there", f"pretraining in '{out}'", arguments, keys_of(source), where)
    values = dict(run_units([unit], workforce)[0].values)
    if DIVERGED in values:
        return pretrain(source, experiment, order, out)  # the run says so itself, as in one process
    _check_seen(Path(out))
    return values


def pretrain_there(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, Any]:
    """Train one network over many machines, or go on with it."""
    config = identity.config
    experiment = build(Experiment, config["experiment"], "of the unit")
    order = Pretrain(method=config["method"], meta=MetaSpec(**config["meta"]), start=where["begun_from"])
    try:
        return pretrain(DataSource.from_plain(where["source"]), experiment, order, where["out"])
    except Diverged as end:
        return {DIVERGED: str(end)}


def finetune_with(
    workforce: Workforce,
    source: str | Path,
    logs: DataSource,
    order: FinetuneRequest,
    out: str | Path,
    progress: Progress = SILENT,
) -> TransferFile:
    """As `edp.workflows.transfer.finetune`, with a unit for each method that trains; this process judges them.

    Args:
        workforce: who trains; nodes see source, logs and run folder under the same paths.
        source: run folder or bundle.
        logs: recordings of the target.
        order: methods and settings.
        out: run folder; what was trained in it goes on.
        progress: receiver of the progress; its units are methods.

    Raises:
        EdpError: as `finetune`; `UnitError` from elsewhere.
        Diverged: the training of the method that is kept diverged.
    """
    names = trained_methods(source, order)
    changes = [change if isinstance(change, str) else dict(change) for change in order.changes]
    where = {
        "source": str(full_path(Path(source))),
        "logs": logs.to_plain(),
        "out": str(full_path(Path(out))),
    }
    units = []
    for name in names:
        arguments = {"name": name, "method": order.method, "spec": asdict(order.spec), "changes": changes}
        label = f"method '{name}'"
        units.append(WorkUnit(f"{__name__}:train_method_there", label, arguments, keys_of(logs), where))

    def note(unit: WorkUnit, result: UnitResult, done: int) -> None:
        progress.note(f"trained: {unit.arguments['name']}, {done} of {len(units)}")

    run_units(units, workforce, on_done=note)
    _check_seen(Path(out))
    return finetune(source, logs, order, out, progress)


def train_method_there(identity: TrainingIdentity, where: Mapping[str, Any]) -> dict[str, Any]:
    """Train one method of a fine-tuning, or go on with it."""
    config = identity.config
    order = FinetuneRequest(
        spec=FinetuneSpec(**config["spec"]), method=config["method"], changes=tuple(config["changes"])
    )
    try:
        train_method(where["source"], DataSource.from_plain(where["logs"]), order, where["out"], config["name"])
    except Diverged as end:
        return {DIVERGED: str(end)}
    return {"trained": config["name"]}


def _check_seen(out: Path) -> None:
    """Refuse a run folder that only the node sees.

    Raises:
        ConfigError: it is not here.
    """
    if not is_file_at(out / "config.toml"):
        raise ConfigError(
            f"the run was written on another node, and is not in '{full_path(out)}' here; give a folder that all nodes "
            "see under the same path"
        )
