"""Is a network with a code for each machine better on a machine that it never saw than one without?

Both are pretrained on the 200 machines of `benchmarks/foundation.py` (those of 12 to 17 t held out), with the same
settings and as many updates: `edp pretrain --method codes`, whose network reads a few numbers that say which machine it
is, and `--method joint`, the rival. The target is the worn C14. With some minutes of its logs `edp finetune --method
code` finds its code and changes nothing else; the rival has the same minutes for all of its weights (`--method full`,
as many updates), or goes as it is.

With ``--many`` a network with codes over 1,000 machines (25 h, one or two minutes of each) stands beside one without
codes over the first 400 of them, after as many updates; on C14, and on 20 machines of 12 to 17 t that neither saw, of
which all but the ends of their logs give the code.

Every training is a run below ``--work``, so that a stopped benchmark goes on; that of the rival is the one of
`benchmarks/foundation.py` where both have the same folder.
"""

from __future__ import annotations

import shutil
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from common import RESULTS, Verdict, finish, in_folder, kept, parser, table, verdict
from edp.config.experiment import Experiment
from edp.jobs import Workforce
from edp.logs.store import is_store
from edp.sim.machine.family import member_mass
from edp.storage import read_json
from edp.workflows.fleet.personal import PersonalOrder, finetune_fleet
from edp.workflows.train_evaluate import DataSource, SimulationOrder, simulate_data_set
from edp.workflows.transfer import FinetuneSpec
from foundation import MINUTES, SCENARIOS, STARTS, Bench, after_minutes, zero_shot

WAYS = (("family", "full"), ("codes", "code"), ("codes", "full"))
"""Start and method of fine-tuning."""
MACHINES, FEW, UNSEEN = 1000, 400, 20
HELD_OUT_MASSES = (12.0, 17.0)


def judge(bench: Bench) -> None:
    """Train, fine-tune, print and judge."""
    quick = bench.quick
    minutes = MINUTES[:1] if quick else MINUTES
    as_it_is = {name: row["mae"] for name, row in zero_shot(bench, ["family", "codes"], "c14").items()}
    errors: dict[str, dict[str, float]] = {}
    for start, method in WAYS:
        tuned = {str(m): after_minutes(bench, start, m, method)["mae"] for m in minutes}
        errors[f"{start}, {method}"] = {"0": as_it_is[start]} | tuned
    print("C14 after some minutes of its logs, k = 10, mm/s")
    rows: list[list[Any]] = [
        [f"{STARTS[key.split(',')[0]]},{key.split(',')[1]}", *row.values()] for key, row in errors.items()
    ]
    table(["start, method", "0 min", *(f"{m} min" for m in minutes)], rows)
    last, code = str(minutes[-1]), errors["codes, code"]
    told = f"{last} min of C14, a code"
    verdicts: list[Verdict] = [
        verdict(
            f"{told} / the network without codes, as it is", code[last], as_it_is["family"], "<= 0.85", "mm/s", quick
        ),
        verdict(
            f"{told} / all weights of the network without codes",
            code[last],
            errors["family, full"][last],
            "<= 1",
            "mm/s",
            quick,
        ),
        verdict("no logs of C14, with codes / without", as_it_is["codes"], as_it_is["family"], "<= 1", "mm/s", quick),
    ]
    finish("fleet_codes", verdicts, bench.seed, errors)


@dataclass(frozen=True)
class Fleet(Bench):
    """The first of 1,000 machines as the family to train on, in a store."""

    machines: int = 0

    @property
    def length(self) -> tuple[int, int]:
        """Epochs and updates of an epoch of a training from random weights."""
        return (2, 40) if self.quick else (8, 300)

    @property
    def all_machines(self) -> int:
        return 24 if self.quick else MACHINES

    def source(self, name: str) -> DataSource:
        """A data set; the family is that of these machines."""
        if name != "family":
            return super().source(name)
        # Of machines that no training sees those that judge are enough.
        spare = {number for number in range(self.all_machines) if self.is_held_out(number)} - set(self.judges())
        return self.stored(f"first_{self.machines}", set(range(self.machines)) - spare)

    def experiment(self, epochs: int, updates: int, *changes: str) -> Experiment:
        """As in `foundation.py`, with fewer of so many machines for validation."""
        share = () if self.quick else ("split.validation_share=0.05",)
        return super().experiment(epochs, updates, *share, *changes)

    def is_held_out(self, number: int) -> bool:
        low, high = HELD_OUT_MASSES
        return low <= member_mass(self.seed, number) <= high

    def judges(self) -> list[int]:
        """Machines that no training saw, and that judge."""
        return [n for n in range(self.all_machines) if self.is_held_out(n)][: 2 if self.quick else UNSEEN]

    def stored(self, name: str, machines: Collection[int]) -> DataSource:
        """A store of the logs of some machines of all, built where it is not there yet."""
        store = self.data / f"store_{name}"
        if not is_store(store):
            chosen = self.data / f"logs_{name}"
            chosen.mkdir(parents=True, exist_ok=True)
            for log, machine in self.logs():
                if machine in machines and not (chosen / log.name).exists():
                    (chosen / log.name).hardlink_to(log)
            DataSource.of(chosen).store(store, 1)
        return DataSource.of(store)

    def logs(self) -> list[tuple[Path, int]]:
        """Logs of all machines, simulated where they are not there yet, each with the number of its machine."""
        count = self.all_machines * 3 // 2
        order = SimulationOrder.of(
            SCENARIOS / "many_machines.toml", seed=self.seed, family=self.all_machines, recordings=count,
            minutes=float(count), truth="without",
        )  # fmt: skip
        paths = simulate_data_set(self.data / "many", order, workers=1)
        numbers = [int(scenario.machine.split("-")[2]) for scenario in order.scenarios()]
        return list(zip(paths, numbers, strict=True))


def unseen_errors(bench: Fleet, start: str, method: str) -> dict[str, Any]:
    """Errors on the ends of the logs of machines held out, mm/s: as the network is, and after fine-tuning."""

    def measure() -> dict[str, Any]:
        alone, store = bench.work / "bundles" / start, bench.stored("held_out", bench.judges()).path
        shutil.copytree(bench.run(start) / "bundle", alone, dirs_exist_ok=True)
        # Of the network without codes only what it is before is asked.
        rounds, updates = (6, ()) if method == "code" else (1, ("training.updates=1",))
        spec = FinetuneSpec(rounds=1 if bench.quick else rounds, check_signs=False)
        order = PersonalOrder(method=method, spec=spec, changes=("training.threads=1", *updates))
        content = finetune_fleet(Workforce(), alone, store, order, bench.work / f"own_{start}")
        rows = [row["mae"] for row in content["machines"] if "mae" in row]
        return {part: [row[part] for row in rows] for part in ("before", "full")}

    return bench.kept(f"unseen {start} {method}", measure)


def judge_many(few: Fleet, many: Fleet) -> None:
    """As `judge`, for 1,000 machines with codes beside fewer without."""
    quick, minutes = few.quick, MINUTES[:1] if few.quick else (1, 5)
    networks = ((few, "family"), (many, "codes"))
    before = {name: zero_shot(bench, [name], "c14")[name]["mae"] for bench, name in networks}
    errors: dict[str, Any] = {}
    for bench, start, method in ((few, "family", "full"), (many, "codes", "code")):
        tuned = {str(m): after_minutes(bench, start, m, method)["mae"] for m in minutes}
        errors[f"{start}, {method}"] = {"0": before[start]} | tuned
    print("C14 after some minutes of its logs, k = 10, mm/s")
    table(
        ["machines, method", "0 min", *(f"{m} min" for m in minutes)],
        [
            [f"{bench.machines}, {key}", *errors[key].values()]
            for bench, key in ((few, "family, full"), (many, "codes, code"))
        ],
    )
    plain, coded = unseen_errors(few, "family", "full"), unseen_errors(many, "codes", "code")
    errors["held out"] = {"without codes": plain["before"], "codes": coded["before"], "code found": coded["full"]}
    means = {name: float(np.mean(row)) for name, row in errors["held out"].items()}
    table(["machines held out, mm/s", *means], [[len(plain["before"]), *means.values()]])
    last = str(minutes[-1])
    named = f"{many.machines} machines, {{}}a code / {few.machines} without codes"
    verdicts: list[Verdict] = [
        verdict(named.format(f"{last} min of C14, "), errors["codes, code"][last], before["family"], "<= 0.85", "mm/s",
                quick),
        verdict(named.format("held-out machines, "), means["code found"], means["without codes"], "<= 0.85", "mm/s",
                quick),
        verdict(f"no logs of C14, {many.machines} machines with codes / {few.machines} without", before["codes"],
                before["family"], "<= 1", "mm/s", quick),
        verdict(named.format(f"{last} min of C14, ") + " of transfer.json", errors["codes, code"][last], published(),
                "<= 0.85", "mm/s", quick),
    ]  # fmt: skip
    spent = {f"{bench.machines}": kept(bench.work / f"trained_{name}.json", dict) for bench, name in networks}
    finish("fleet_codes_many", verdicts, few.seed, errors | {"spent": spent})


def published() -> float:
    """Return the error of the fully trained 400-machine network on C14 without logs, mm/s, from ``transfer.json``."""
    verdicts, name = read_json(RESULTS / "transfer.json")["verdicts"], "network of many machines over direct transfer"
    return float(next(one["ours"] for one in verdicts if one["name"] == name))


def main() -> None:
    """Command line."""
    options = parser(__doc__ or "")
    options.add_argument(
        "--work", type=Path, default=None, help="folder of runs and results; a stopped benchmark goes on"
    )
    options.add_argument("--many", action="store_true", help="1,000 machines with codes beside 400 without")
    chosen = options.parse_args()
    torch.set_num_threads(1)
    if chosen.many:
        few, many = (12, 24) if chosen.quick else (FEW, MACHINES)

        def fleet(work: Path, machines: int) -> Fleet:
            data = chosen.data or work / "data"
            return Fleet(work / f"first_{machines}", data, chosen.seed, chosen.quick, machines)

        in_folder(chosen.work, lambda work: judge_many(fleet(work, few), fleet(work, many)))
        return
    in_folder(chosen.work, lambda work: judge(Bench(work, chosen.data or work / "data", chosen.seed, chosen.quick)))


if __name__ == "__main__":
    main()
