"""Fine-tuning on recordings made by others: from one regime of a plant to another, beside rivals on the same ticks.

Each set has two recordings: the first and the second part of a run (time-shifted), or two kinds of excitation. The
network of the first is trained on with the second by what ``edp train finetune`` does; its rivals are direct transfer,
training from scratch and ridge ARX on the second alone. No machine changes in these sets, so what they show is that
the command works on logs of other makes and rates, and how much a few tens of seconds of a changed regime bring; not
what a transfer between machines brings.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from common import EXAMPLES, SHARED, Bench, benchmark, table, verdict
from edp.config.experiment import load_experiment
from edp.logs import write_recording
from edp.storage import make_folder
from edp.workflows.train_evaluate import DataSource, train
from edp.workflows.transfer import METHODS, FinetuneRequest, FinetuneSpec, finetune
from verdicts import Verdict

OWN_NETWORK = "small"
OURS, NONE = "full", "direct"
RIVALS = (NONE, "scratch", "ridge_arx", "rehearsal")
RATES = (3e-3, 1e-2, 3e-2)  # the validation part chooses
SPEC = FinetuneSpec(batch=8, single_phase_epochs=20)  # seconds of logs do not hold more lanes
CHANGES = ('split={kind="time"}', "training.refit=none")


@dataclass(frozen=True)
class Regimes:
    """Two regimes of one plant.

    Attributes:
        title: as the table calls it.
        data: data-set file with two recordings, in ``examples/real``.
        settings: settings file beside it.
        change: what differs.
    """

    title: str
    data: str
    settings: str
    change: str


SETS = (
    Regimes("two cylinders on one supply", "cylinders.toml", "cylinders_settings.toml", "later in the run"),
    Regimes("fatigue rig", "faster.toml", "faster_settings.toml", "later in the run"),
    Regimes("positioning axis", "emps.toml", "emps_settings.toml", "pulses of force added"),
)
QUICK_SETS = SETS[:1]


def transferred(regimes: Regimes, work: Path, quick: bool, seed: int) -> dict[str, Any]:
    """Train on the first recording, fine-tune on the second; the content of ``transfer.json``."""
    first, second = DataSource.from_path(EXAMPLES / regimes.data).read()
    for name, recording in (("source", first), ("target", second)):
        write_recording(recording, make_folder(work / name) / f"{recording.name}.parquet")
    changes = [f"training.seed={seed}", "training.threads=1", *CHANGES, *(["training.epochs=2"] if quick else [])]
    experiment = load_experiment(EXAMPLES / regimes.settings, OWN_NETWORK, changes)
    train(DataSource.from_path(work / "source"), experiment, work / "run")
    specs = [replace(SPEC, single_phase_epochs=2)] if quick else [replace(SPEC, learning_rate=rate) for rate in RATES]
    logs = DataSource.from_path(work / "target")
    tried = {work / f"tuned_{number}": FinetuneRequest(spec=spec, method=OURS) for number, spec in enumerate(specs)}
    for folder, order in tried.items():
        finetune(work / "run", logs, order, folder)
    best = min(tried, key=validation)
    return finetune(
        work / "run", logs, replace(tried[best], baselines=RIVALS), best
    ).to_table()  # what is trained is read


def validation(folder: Path) -> float:
    """Least validation error of a training, in standard deviations."""
    rows = (folder / "history.jsonl").read_text(encoding="utf-8").splitlines()
    return min(float(json.loads(row)["validation_score"]) for row in rows)


def rows_of(regimes: Regimes, found: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """Root-mean-square errors of each target and horizon by method, in the units of the logs."""
    for horizon in found["task"]["horizons"]:
        for target in found["targets"]:
            errors = {
                name: row["domains"]["target"][str(horizon)][target["name"]]["rmse"]
                for name, row in found["methods"].items()
            }
            yield {"set": regimes.title, "target": target["name"], "horizon": horizon, "rmse": errors}


def verdicts_of(rows: Sequence[dict[str, Any]]) -> Iterator[Verdict]:
    """Fine-tuned against direct transfer and against training from scratch: geometric mean over the rows of a set."""
    for title in dict.fromkeys(row["set"] for row in rows):
        held = [row["rmse"] for row in rows if row["set"] == title]
        for rival, name in ((NONE, "direct transfer"), ("scratch", "training from scratch")):
            ratio = statistics.geometric_mean(errors[OURS] / errors[rival] for errors in held)
            yield verdict(f"{title}: fine-tuned against {name}", ratio, 1.0, "<= 1", "RMSE ratio")


@benchmark(SHARED)
def main(bench: Bench) -> object:
    rows: list[dict[str, Any]] = []
    sets: dict[str, Any] = {}
    for regimes in QUICK_SETS if bench.quick else SETS:
        print(f"{regimes.data} ...", file=sys.stderr, flush=True)
        found = transferred(regimes, bench.folder / regimes.data, bench.quick, bench.seed)
        sets[regimes.title] = {"minutes": found["data"]["minutes"], "rate": found["settings"]["rate"]}
        rows += rows_of(regimes, found)
    names = [OURS, *RIVALS]
    print("\nRMSE k steps ahead on the end of the second recording, units of the logs")
    heads = ["set", "target", "k", *(METHODS[name].label for name in names)]
    table(heads, [[row["set"], row["target"], row["horizon"], *(row["rmse"][n] for n in names)] for row in rows])
    bench.verdicts += verdicts_of(rows)
    return {"sets": sets, "rows": rows}


if __name__ == "__main__":
    main()
