"""Does a physics base help a network to other machines (RQ1 of the thesis), over seeds and machines?

Small networks learn on M22 in free air, without a base, with the kinematic one and with that of forces; then they are
taken to a worn C14 with its full sensor model and to a drawn machine of 32 t, both in air and soil, as they are and
after five minutes of logs. The base has the geometry of the machine that it runs on and reads noise-free strokes, which
is the best that can be told to it. `transfer.py` asks the same of one machine and one seed, and of other geometries.

A seed draws the weights, the order of the training and the logs that fine-tuning sees. All judge the same logs.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from common import finish, in_folder, kept, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.storage import make_folder
from edp.workflows.train_evaluate import DataSource, train
from edp.workflows.transfer import METHODS, FinetuneSpec
from edp.workflows.transfer.case import TransferCase
from edp.workflows.transfer.methods import Made
from edp.workflows.transfer.scores import measure
from edp.workflows.transfer.source import SourceModel, read_source, target_experiment
from transfer import BASES, LOG_MIN, SKIP, divided, of_machine, order_of, shortened
from transfer_views import HORIZON, NONE, OURS

MACHINES = ("C14", "family-0-5")
NETWORKS = ("none", "kinematic", "force")
FEW = 5
"""Minutes of a target's logs on which a network is trained further, one a log."""


@dataclass(frozen=True)
class Lengths:
    """How long everything is."""

    source_min: float
    logs: int
    training: tuple[str, ...]
    spec: FinetuneSpec


FULL = Lengths(24.0, 12, ("training.epochs=4", "training.updates=200"), FinetuneSpec())
QUICK = Lengths(4.0, 2, ("training.epochs=1", "training.updates=4"), FinetuneSpec(rounds=1))
NETWORK = 'model.backbone={kind="hybrid", channels=[32], kernel=5, units=32}'


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--work", type=Path, default=None, help="folder that keeps data and finished cells")
    made.add_argument("--seeds", type=int, default=3, help="trainings of each network")
    arguments = made.parse_args()
    if arguments.quick:
        arguments.seeds = 1
    in_folder(arguments.work, lambda work: run(arguments, work))


def run(arguments: Any, work: Path) -> None:
    """All networks on all machines."""
    lengths, first = QUICK if arguments.quick else FULL, arguments.seed
    simulate(work, lengths, first)
    rows: dict[str, dict[str, list[float]]] = {}
    for seed in range(first, first + arguments.seeds):
        for base in NETWORKS:
            found = kept(
                make_folder(work / "cells") / f"{base}_{seed}.json",
                lambda base=base, seed=seed: cell(work, lengths, base, seed),
            )
            for where, error in found.items():
                rows.setdefault(where, {}).setdefault(base, []).append(error)
            print(f"seed {seed}, {base}: {found}", flush=True)
    show(rows)
    asked = [
        verdict(
            f"{base} base, {where}, against none (median of the seeds' ratios)",
            statistics.median(ours / none for ours, none in zip(errors[base], errors["none"], strict=True)),
            1.0,
            "<= 0.97",
            "1",
            arguments.quick,
        )
        for where, errors in rows.items()
        for base in NETWORKS
        if base != "none"
    ]
    finish("physics_transfer", asked, first, rows)


def simulate(work: Path, lengths: Lengths, seed: int) -> None:
    """Logs of the source and of each target, with strokes for a base to read."""
    minutes = lengths.source_min
    simulate_data_set(work / "m22", SimulationOrder(minutes=minutes, recordings=int(minutes / 2), seed=seed))
    for machine in MACHINES:
        order = order_of(LOG_MIN * lengths.logs, lengths.logs, seed + 100, truth="with", machine=machine)
        simulate_data_set(work / machine, order)


def cell(work: Path, lengths: Lengths, base: str, seed: int) -> dict[str, float]:
    """Errors of a network ten ticks ahead, mm/s: on its own machine, and on each target before and after its logs."""
    place = make_folder(work / "runs" / f"{base}_{seed}")
    physics = [f"model.physics={BASES[base]}"] if BASES[base] else []
    fixed = ("task.horizons=[10]", "training.threads=1", "training.patience=0", f"training.seed={seed}")
    experiment = load_experiment(None, "quick", [*fixed, NETWORK, *lengths.training, *physics])
    train(DataSource.of(work / "m22"), experiment, place / "source")
    source = read_source(place / "source")
    if source.data is None:
        raise SystemExit("the source's recordings are gone; its own error cannot be measured")
    found = {"M22, its own": error(METHODS[NONE]().make(case_of(source, source.data, work, place, seed)), source.data)}
    for machine in MACHINES:
        begun = of_machine(source, machine) if BASES[base] else source
        data = divided(begun, DataSource.of(work / machine))
        few = shortened(data, min(FEW, lengths.logs), seed)
        for method, parts in ((NONE, data), (OURS, few)):
            case = case_of(begun, parts, work / machine, place / machine / method, seed)
            found[f"{machine}, {method}"] = error(METHODS[method]().make(replace(case, spec=lengths.spec)), data)
    return found


def case_of(source: SourceModel, data: Prepared, logs: Path, folder: Path, seed: int) -> TransferCase:
    """A transfer to some logs, with the usual rates."""
    experiment = target_experiment(source, (f"training.seed={seed}",))
    return TransferCase(source, DataSource.of(logs), data, experiment, FinetuneSpec(), folder)


def error(made: Made, data: Prepared) -> float:
    """Mean absolute error over the cylinders on the test parts, mm/s."""
    return float(measure(made.predict(data), data, SKIP)[HORIZON]["mean"]["mae"])


def show(rows: dict[str, dict[str, list[float]]]) -> None:
    """Print means over the seeds, and each seed's ratio to the network without a base."""
    lines = []
    for where, errors in rows.items():
        for base, own in errors.items():
            ratios = " ".join(f"{mine / none:.2f}" for mine, none in zip(own, errors["none"], strict=True))
            lines.append([where, base, statistics.mean(own), ratios])
    table(["machine", "base", "MAE, mm/s", "ratio to none, by seed"], lines)


if __name__ == "__main__":
    main()
