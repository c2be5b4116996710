"""`edp train finetune --fleet`: one network, and a delta of kilobytes for each machine of a store."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from edp import __version__
from edp.config.experiment import Change
from edp.data.prepared import Prepared
from edp.errors import ConfigError, EdpError, StorageError, closest
from edp.evaluation.fleet_file import FleetFile, MachineDelta
from edp.evaluation.judge import score_predictions
from edp.evaluation.scores_file import MEAN, metric
from edp.jobs import Workers
from edp.jobs.workers import UNITS, WorkUnit
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.progress import SILENT, Progress
from edp.settings.results import read_part
from edp.signals import KINDS
from edp.storage import make_folder, write_bytes
from edp.storage.ledger import TrainingIdentity, WithState
from edp.storage.paths import full_path, is_file_at
from edp.storage.runs import Run, check_claimable, missing_text, run_key
from edp.training.bundle import load_bundle, save_bundle, weights_digest
from edp.training.delta import DELTA_BYTES, SUFFIX, apply_delta, delta_from_bytes, delta_of, read_delta
from edp.workflows.fleet.machines import MachineSource, StoredMachine, machines_of
from edp.workflows.transfer import METHODS, FinetuneRequest, FinetuneSpec
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.finetune import target_data
from edp.workflows.transfer.source import SourceModel, read_source, target_experiment

DELTAS = "deltas"


@dataclass(frozen=True, kw_only=True)
class PersonalOrder:
    """Settings of the fine-tuning for each machine.

    Attributes:
        method: method of the fine-tuning, which must train and need no recordings of the source.
        spec: its settings.
        changes: settings of the trainings that differ from those of the source.
        most_bytes: maximum size of a delta.

    Raises:
        ConfigError: a method that does not do here, or no room for a delta.
    """

    method: str = "full"
    spec: FinetuneSpec = field(default_factory=FinetuneSpec)
    changes: tuple[Change, ...] = ()
    most_bytes: int = DELTA_BYTES

    def __post_init__(self) -> None:
        method = METHODS[self.method]
        if not method.trains or method.needs_source:
            able = ", ".join(name for name, one in METHODS.items() if one.trains and not one.needs_source)
            raise ConfigError(f"method '{self.method}' cannot make the networks of a fleet; one of {able} can")
        if not 2**13 <= self.most_bytes <= 2**24:
            raise ConfigError(f"a delta of {self.most_bytes} bytes; give 8192 to 16777216")


def finetune_fleet(
    workers: Workers,
    source: str | Path,
    store: str | Path,
    order: PersonalOrder,
    out: str | Path,
    progress: Progress = SILENT,
) -> FleetFile:
    """Fine-tune a network for each machine of a store, and keep what changed.

    Each recording is divided by time: its beginning trains, a part validates, its end tests. A machine that is done is
    not done again when the command is given again, with more machines in the store, too.

    Args:
        workers: who trains; nodes see source and store under the same paths.
        source: run folder or bundle of the fleet's network.
        store: recordings that say their machine.
        order: method, settings, bytes.
        out: folder for ``fleet.json`` and ``deltas``.
        progress: receiver of the progress; its units are machines.

    Returns:
        The content of ``fleet.json``. A machine whose logs do not go with the network is in it with the reason.

    Raises:
        EdpError: a source or store that cannot be used.
    """
    check_claimable(out, "fleet")
    base = read_source(source, recordings=False)
    digest = weights_digest(base.predictor)
    machines = machines_of(store)
    # Without the machines: more of them may be added to the same fleet.
    key = run_key({"fleet": asdict(order), "base": digest}, "")
    units = [_unit(machine, digest, source, store, order) for machine in machines]

    machines_done = progress.stage("machine", len(units))

    with Run.create(out, "fleet", key) as run:
        results = list(workers.map_in_order(units, machines_done, run.file(UNITS)))
        rows = []
        for machine, result in zip(machines, results, strict=True):
            row = {"machine": machine.name, "minutes": round(machine.minutes, 3), **result.values}
            if result.content is not None:
                row["delta"] = f"{DELTAS}/{file_of(machine.name)}"
                write_bytes(make_folder(run.file(DELTAS)) / file_of(machine.name), result.content)
            rows.append(read_part(MachineDelta, row, f"the result of machine '{machine.name}'"))
        content = FleetFile(
            edp=__version__,
            base=digest,
            source=str(full_path(Path(source))),
            store=str(full_path(Path(store))),
            method=order.method,
            most_bytes=order.most_bytes,
            unit=_unit_of(base),
            horizon=base.bundle.task.horizons[0],
            rate_hz=base.bundle.task.rate_hz,
            machines=tuple(rows),
        )
        content.write(run.path)
    return content


def network_of(folder: str | Path, machine: str, out: str | Path, base: str | Path | None = None) -> Path:
    """Write the network of a machine, the fleet's with its delta, as a bundle.

    Args:
        folder: folder of `finetune_fleet`.
        machine: its name.
        out: folder of the bundle.
        base: run folder or bundle of the fleet's network; None where ``fleet.json`` says that it lies.

    Returns:
        The folder of the bundle.

    Raises:
        ConfigError: no such machine, or one without a delta.
        BundleError: the delta is one of another network, or damaged.
    """
    content = read_fleet(folder)
    rows = {row.machine: row for row in content.machines}
    if machine not in rows:
        raise ConfigError(f"'{folder}' has no machine '{machine}'{closest(machine, rows)}")
    if rows[machine].failed is not None:
        raise ConfigError(f"machine '{machine}' has no network of its own: {rows[machine].failed}")
    bundle = load_bundle(base or content.source)
    delta = read_delta(Path(folder, DELTAS, file_of(machine)))
    own = apply_delta(bundle.predictor, delta)
    strategy = {"method": "delta", "source": {"weights": delta.base}, **delta.facts}
    provenance = bundle.provenance.add_entries(strategy=strategy)
    return save_bundle(replace(bundle, predictor=own, provenance=provenance, scores={}), out)


def file_of(machine: str) -> str:
    """Name of the file of a machine's delta: names of machines come from logs, and may be anything."""
    return hashlib.blake2b(machine.encode(), digest_size=12).hexdigest() + SUFFIX


def read_fleet(folder: str | Path) -> FleetFile:
    """Return the content of ``fleet.json``.

    Raises:
        StorageError: it is missing, damaged or of another version.
    """
    if not is_file_at(Path(folder, FleetFile.NAME)):
        raise StorageError(missing_text(folder, "fleet", "a fleet"))
    return FleetFile.read(folder)


def _unit_of(base: SourceModel) -> str:
    units = {KINDS[kind].report_unit for kind in base.bundle.target_kinds}
    return units.pop() if len(units) == 1 else "mixed units"


def _unit(machine: StoredMachine, digest: str, source: str | Path, store: str | Path, order: PersonalOrder) -> WorkUnit:
    changes = [change if isinstance(change, str) else dict(change) for change in order.changes]
    arguments = {
        "machine": machine.name,
        "base": digest,
        "method": order.method,
        "spec": asdict(order.spec),
        "changes": changes,
        "most_bytes": order.most_bytes,
    }
    where = {"source": str(full_path(Path(source))), "store": str(full_path(Path(store)))}
    return WorkUnit(f"{__name__}:tune_machine", machine.name, arguments, " ".join(machine.digests), where)


def tune_machine(identity: TrainingIdentity, where: Mapping[str, Any]) -> WithState | dict[str, Any]:
    """Fine-tune for one machine and return the change of the weights."""
    config = identity.config
    base = _source(where["source"], config["base"])
    logs = MachineSource(Path(where["store"]), machine=config["machine"])
    request = FinetuneRequest(
        spec=FinetuneSpec(**config["spec"]), method=config["method"], changes=tuple(config["changes"])
    )
    try:
        experiment = target_experiment(base, request.changes)
        data, _ = target_data(base, logs, experiment, request)
        with tempfile.TemporaryDirectory(prefix="edp-machine-") as folder:
            case = TransferCase(base, logs, data, experiment, request.spec, Path(folder))
            network = METHODS[request.method]().make(case).network
    except EdpError as error:
        # A machine without usable logs must not end the fleet's run; other machines go on.
        return {"failed": str(error)}
    if network is None:
        raise RuntimeError(f"method '{request.method}' left no network")
    minutes = sum(part.samples for part in data.train) / data.task.rate_hz / 60.0
    facts = {"machine": config["machine"], "method": request.method, "minutes": round(minutes, 3)}
    content = delta_of(base.predictor, network, facts, config["most_bytes"]).to_bytes()
    delta = delta_from_bytes(content, "the delta")
    errors = {
        "before": _errors(base.predictor, data),
        "full": _errors(network, data),
        "delta": _errors(apply_delta(base.predictor, delta), data),
    }
    facts_of_delta = {"bytes": len(content), "rank": delta.rank, "trained_min": facts["minutes"]}
    return WithState({**facts_of_delta, "mae": errors}, content)


def _errors(network: Predictor, data: Prepared) -> float:
    """Return the mean absolute error over the outputs at the first horizon, on the ends of the recordings.

    In report units.
    """
    skip = max(network.spec.window, data.task.features.init_samples)
    scores = score_predictions(stream_predictions(network, data.test), data, skip)
    return metric(scores.overall[str(data.task.horizons[0])][MEAN], "mae")


@lru_cache(maxsize=1)
def _source(path: str, digest: str) -> SourceModel:
    """Return the fleet's network, read once for all machines of a process; `digest` identifies it."""
    source = read_source(path, recordings=False)
    if weights_digest(source.predictor) != digest:
        raise ConfigError(f"'{path}' holds another network on this node; all nodes must see the same file there")
    return source
