"""What is one network over many random machines worth on a machine that it never saw?

A foundation network learns from 200 machines of 10 to 50 t in free air and three soils, with the sensors of a machine
in the field; those of 12 to 17 t are held out. The target is the worn C14 of 14 to 15 t. The rival is a network of the
same specs after the same number of updates, and so after the same processor time, of M22 in free air: the thesis's
source.

Three questions. Zero-shot: the error on C14's logs in air and soil, and in clay, which no network saw. Few minutes: the
error after 1, 2 and 5 minutes of other logs of C14, from either start, and in a few steps of gradient descent from a
meta-learned one. Memory: the error by how long before it the state was reset, on held-out machines and on C14.

Every training is a run below ``--work``, so that a stopped benchmark goes on.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from accuracy_league import kept
from common import Verdict, finish, in_folder, parser, table, verdict
from edp.config.experiment import Experiment, load_experiment
from edp.data.series import Series
from edp.evaluation.context import context_errors
from edp.networks.predictor import Predictor
from edp.networks.running import stream_predictions
from edp.signals import Kind
from edp.training import TrainingProgress, load_bundle
from edp.workflows.pretraining import MetaSpec, Pretrain, pretrain
from edp.workflows.train_evaluate import DataSource, SimulationOrder, simulate_data_set, train, trained_run
from edp.workflows.transfer import FinetuneRequest, FinetuneSpec, finetune

SCENARIOS = Path(__file__).resolve().parents[1] / "examples" / "scenarios"
HORIZON = 10
MINUTES = (1, 2, 5)
LOGS_A_MINUTE = 2
NETWORK = (
    "model.backbone.channels=[64]",
    "model.backbone.units=64",
    "training.loss.delta=0.1",
    "training.threads=1",
    "training.patience=0",
)
HELD_OUT = ('split.kind="machines"', "split.test_masses=[12.0, 17.0]")
STARTS = {
    "m22": "M22 in free air",
    "family": "foundation",
    "meta": "meta-learned",
    "codes": "with codes",
}


@dataclass(frozen=True)
class Bench:
    """Where the benchmark stands, and how long its trainings are.

    Attributes:
        work: folder of data, runs and results.
        data: folder of simulated data.
        seed: of data and trainings.
        quick: the short form.
    """

    work: Path
    data: Path
    seed: int
    quick: bool

    @property
    def length(self) -> tuple[int, int]:
        """Epochs and updates of an epoch of a training from random weights."""
        return (2, 40) if self.quick else (12, 350)

    def source(self, name: str) -> DataSource:
        """A data set, simulated where it is not there yet."""
        place = self.data / name.replace(" ", "_")
        simulate_data_set(place, orders(self.quick, self.seed)[name], workers=1)
        return DataSource.of(place)

    def run(self, name: str) -> Path:
        """The folder of a training."""
        return self.work / "runs" / name.replace(" ", "_")

    def experiment(self, epochs: int, updates: int, *changes: str) -> Experiment:
        """The network that all are, and how it is trained."""
        lengths = (f"training.epochs={epochs}", f"training.updates={updates}", f"training.seed={self.seed}")
        return load_experiment(None, "standard", [*NETWORK, *lengths, *changes])

    def kept(self, label: str, measure: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """What an earlier run of this benchmark measured, or what is found now."""
        return kept(self.work / f"{label.replace(' ', '_')}.json", measure)

    def series(self, name: str, network: Predictor) -> list[Series]:
        """All recordings of a data set, as a network reads them."""
        return [network.task.series(recording) for recording in self.source(name).read()]


def orders(quick: bool, seed: int) -> dict[str, SimulationOrder]:
    """What is simulated, by name."""
    c14 = {"suffix": ".parquet", "layout": "", "truth": "with"}
    clay = {"mix": {"dig": 0.6, "grading": 0.4}, "materials": {"clay": 1.0}}
    few = {"family": 12, "minutes": 12.0, "recordings": 12} if quick else {}
    test = {"minutes": 3.0, "recordings": 2} if quick else {}
    one = {"minutes": 6.0, "recordings": 6} if quick else {"minutes": 300.0, "recordings": 200}
    soil = SCENARIOS / "c14_soil.toml"
    return {
        "family": SimulationOrder.of(SCENARIOS / "many_machines.toml", seed=seed, **few),
        "m22": SimulationOrder.of(SCENARIOS / "m22.toml", seed=seed, **one),
        "c14": SimulationOrder.of(soil, seed=seed, **c14, **test),
        "c14 clay": SimulationOrder.of(soil, seed=seed, minutes=12.0, recordings=8, **clay, **c14),
        "minutes": SimulationOrder.of(soil, seed=seed + 1000, minutes=5.0, recordings=10, **c14),
    }


def trained(bench: Bench, name: str) -> Predictor:
    """A network from random weights, or where it is meta-learned from the foundation network."""

    def make() -> dict[str, Any]:
        began = time.process_time()
        epochs, updates = bench.length

        def tell(event: TrainingProgress) -> None:
            if event.row is not None and event.epoch % 4 == 0:
                print(f"{name}: epoch {event.epoch}, validation MAE {event.row['validation_mae']:.3f}", flush=True)

        if name in ("family", "codes"):
            order = Pretrain(method="codes" if name == "codes" else "joint")
            pretrain(bench.source("family"), bench.experiment(epochs, updates, *HELD_OUT), order, bench.run(name), tell)
        elif name == "meta":
            # A twelfth of the updates: each of them goes through twice the ticks, and three times more to adapt.
            rate = 'training.optimizer={kind="soap",learning_rate=1e-3}'
            pieces = ("training.chunks.batch=16", "training.chunks.length=256")
            experiment = bench.experiment(max(1, epochs // 2), max(1, updates // 6), *HELD_OUT, *pieces, rate)
            order = Pretrain(method="fomaml", meta=MetaSpec(inner_rate=1.0), start=bench.run("family"))
            pretrain(bench.source("family"), experiment, order, bench.run(name), tell)
        else:
            train(bench.source(name), bench.experiment(epochs, updates), bench.run(name), tell)
        return {"cpu_s": time.process_time() - began}

    bench.kept(f"trained {name}", make)
    return load_bundle(bench.run(name)).predictor


def errors(network: Predictor, series: list[Series]) -> np.ndarray[Any, Any]:
    """Mean absolute error of each series and target in mm/s, from reset, start-up left out."""
    skip = network.spec.window
    found = []
    for values, part in zip(stream_predictions(network, series), series, strict=True):
        truth = part.targets[HORIZON:]
        found.append(1e3 * np.abs(values[skip : len(truth), 0] - truth[skip:]).mean(axis=0))
    return np.stack(found)


def persistence(series: list[Series]) -> float:
    """Error of saying that nothing changes, mm/s."""
    return float(np.mean([1e3 * np.abs(part.targets[HORIZON:] - part.targets[:-HORIZON]).mean() for part in series]))


def zero_shot(bench: Bench, names: list[str], target: str) -> dict[str, Any]:
    """Errors of networks on logs of a machine that none of them saw."""

    def measure(name: str) -> dict[str, Any]:
        network = trained(bench, name)
        series = bench.series(target, network)
        each = errors(network, series)
        return {"mae": float(each.mean()), "by_target": each.mean(axis=0).tolist(), "persistence": persistence(series)}

    return {name: bench.kept(f"zero-shot {name} on {target}", lambda name=name: measure(name)) for name in names}


def after_minutes(bench: Bench, start: str, minutes: int, method: str) -> dict[str, Any]:
    """Error on C14's test logs after fine-tuning with some minutes of other logs."""

    def measure() -> dict[str, Any]:
        trained(bench, start)
        logs = bench.work / "minutes" / str(minutes)
        logs.mkdir(parents=True, exist_ok=True)
        for log in sorted(bench.source("minutes").path.glob("*.parquet"))[: LOGS_A_MINUTE * minutes]:
            shutil.copy(log, logs / log.name)
        alone = bench.work / "bundles" / start.replace(" ", "_")  # without its run, whose world is not judged here
        shutil.copytree(bench.run(start) / "bundle", alone, dirs_exist_ok=True)
        rounds, updates = (2, 4) if bench.quick else (8, 15)
        spec = FinetuneSpec(rounds=rounds, batch=16, patience=0, smoothness=0.0, check_signs=False)
        changes = ("split.validation_share=0.2", "split.test_share=0.05", f"training.updates={updates}")
        order = FinetuneRequest(
            spec=spec, method=method, changes=(*changes, "training.loss.delta=0.1", "training.threads=1")
        )
        began = time.process_time()
        out = bench.work / "tuned" / f"{start}_{minutes}_{method}".replace(" ", "_")
        finetune(alone, DataSource.of(logs), order, out)
        network = load_bundle(out).predictor
        each = errors(network, bench.series("c14", network))
        return {"mae": float(each.mean()), "cpu_s": time.process_time() - began}

    return bench.kept(f"after {minutes} min {start} {method}", measure)


def memory(bench: Bench, name: str, where: str) -> dict[str, Any]:
    """Errors by the time since reset, on C14 or on the machines that the foundation network holds out."""

    def measure() -> dict[str, Any]:
        network = trained(bench, name)
        if where == "c14":
            series = bench.series(where, network)
        else:
            series = trained_run(bench.run("family"))[3].test
        return context_errors(network, series, [Kind.VELOCITY] * 3).to_json()

    return bench.kept(f"memory of {name} on {where}", measure)


def show_minutes(bench: Bench) -> dict[str, Any]:
    """Errors by start and minutes, printed."""
    steps = [("m22", "full"), ("family", "full"), ("family", "few_steps"), ("meta", "few_steps")]
    found: dict[str, Any] = {}
    minutes = MINUTES[:1] if bench.quick else MINUTES
    for start, method in steps:
        before = zero_shot(bench, [start], "c14")[start]["mae"]
        row = {"0": before} | {str(m): after_minutes(bench, start, m, method)["mae"] for m in minutes}
        found[f"{start}, {method}"] = row
    print("\nC14 after some minutes of its logs, k = 10, mm/s")
    rows = [[_label(key), *row.values()] for key, row in found.items()]
    table(["start, method", "0 min", *(f"{m} min" for m in minutes)], rows)
    return found


def _label(key: str) -> str:
    name, _, rest = key.partition(",")
    return f"{STARTS[name]},{rest}"


def show_memory(bench: Bench, names: list[str]) -> dict[str, Any]:
    """Errors by the time since reset, printed."""
    found = {f"{name}, {where}": memory(bench, name, where) for name in names for where in ("held out", "c14")}
    print("\nError by the seconds since the state was reset, k = 10, mm/s")
    seconds = [row["seconds"] for row in next(iter(found.values()))["contexts"]]
    rows = [[_label(key), *(row["mae"] for row in held["contexts"])] for key, held in found.items()]
    table(["network", *(f"{s:g} s" for s in seconds)], rows)
    return found


def main() -> None:
    """Train, judge and print."""
    made = parser(__doc__ or "")
    made.add_argument("--work", type=Path, default=None, help="folder of runs and results; a stopped benchmark goes on")
    arguments = made.parse_args()
    torch.set_num_threads(1)
    data, seed, quick = arguments.data, arguments.seed, arguments.quick
    in_folder(arguments.work, lambda work: judge(Bench(work, data or work / "data", seed, quick)))


def judge(bench: Bench) -> None:
    """All questions in turn."""
    quick = bench.quick
    names = ["m22", "family"]
    found = {target: zero_shot(bench, names, target) for target in (["c14"] if quick else ["c14", "c14 clay"])}
    print("C14 without a minute of its logs, k = 10, mm/s")
    rows = [[STARTS[name], *(found[target][name]["mae"] for target in found)] for name in names]
    table(["network", *found], [*rows, ["persistence", *(found[target]["m22"]["persistence"] for target in found)]])
    tuned = show_minutes(bench)
    remembered = show_memory(bench, ["family"])
    last = next(reversed(tuned["m22, full"]))
    contexts = remembered["family, held out"]["contexts"]
    mae = {name: row["mae"] for name, row in found["c14"].items()}
    verdicts: list[Verdict] = [
        verdict("zero-shot on C14, foundation / direct transfer", mae["family"], mae["m22"], "<= 0.6", "mm/s", quick),
        verdict(
            f"{last} min of C14, from the foundation / from M22",
            tuned["family, full"][last],
            tuned["m22, full"][last],
            "<= 1",
            "mm/s",
            quick,
        ),
        verdict(
            f"a few steps with {last} min of C14, meta-learned / foundation",
            tuned["meta, few_steps"][last],
            tuned["family, few_steps"][last],
            "<= 1",
            "mm/s",
            quick,
        ),
        verdict(
            f"held-out machines, {contexts[-1]['seconds']:g} s of memory / {contexts[0]['seconds']:g} s",
            contexts[-1]["mae"],
            contexts[0]["mae"],
            "<= 0.95",
            "mm/s",
            quick,
        ),
    ]
    spent = {path.stem.removeprefix("trained_"): kept(path, dict) for path in sorted(bench.work.glob("trained_*.json"))}
    finish(
        "foundation", verdicts, bench.seed, {"zero_shot": found, "minutes": tuned, "memory": remembered, "spent": spent}
    )


if __name__ == "__main__":
    main()
