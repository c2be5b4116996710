"""Does the on-board adaptation win back what a step change of the machine costs, at little cost, and never diverge?

A network of M22 with cold oil (20 degrees, free air) meets three changes: oil at 65 degrees, clay, and dead bands that
are 3 points wider. The same scenarios (same seeds of the operator) are run on the machine before and after; each
recording starts with nothing learned. The loss is the MAE of the frozen network after the change less its MAE before,
on the ticks behind 60 s of motion, k = 10, mean over cylinders; what is recovered is the share of it by which the
adapted network is better than the frozen one on the same ticks. An adaptation that helps the unchanged machine as well
recovers more than the change has cost: so the gain before is shown, and the share without it ("of the change").
A change makes the future harder to know for any predictor: how much is shown by networks trained after it.

The options' defaults were chosen on other recordings of these scenarios (seed 50) than those that count here (seed 90).

A grey box of the machine as it was follows the machine, too (the C code of `edp export --format follower`), alone and
before the correction above, without and with a thermometer in the oil.

Rivals on the same ticks: no adaptation; offset and gain of each predicted change, by recursive least squares; the whole
last layer's features by recursive least squares with forgetting and no bounds, from the backbone's representation.

Cost: instructions per sample on an emulated Cortex-M4F, with and without `adapt`. Divergence: the C code for 24 h under
an adversary (tests/export/adversary.c), around a narrow network with weights as drawn, so that a day takes a minute: an
adaptation sees inputs and predictions only, and those of such a network are worse.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from board import BOARD, M7, QEMU_M7, build_image, listed_sources, on_board, run, run_image, sizes_on_m7
from common import DATA_AND_PARTS, ROOT, Bench, benchmark, option, table
from controller_cycles import PROGRAM
from edp.config.experiment import load_experiment
from edp.config.twin import load_twin_experiment
from edp.data.oil import oil_celsius
from edp.data.scaling import Scaler
from edp.data.series import Series
from edp.export.c.model import make_model
from edp.export.c.target import CTarget
from edp.export.follower import FollowerParts, write_follower
from edp.export.follower.parts import GOLDEN_TICKS
from edp.ir.rls import Adaptation, AdaptationSpec, RlsCorrector
from edp.jobs import IN_PROCESS
from edp.networks.backbones import HybridSpec
from edp.networks.predictor import Predictor, build_model
from edp.networks.running import stream_hidden, stream_predictions
from edp.networks.twin import fit_scales
from edp.networks.twin.adaptive_twin import TunedSpec
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.greybox import GreyTwin
from edp.recording import Recording
from edp.sim.machine import machine_files
from edp.storage import make_folder
from edp.training import load_bundle, save_bundle
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle, holds_twin, load_twin, plant_bundle, save_twin
from edp.workflows.adaptation import fit_adaptation, motion_s
from edp.workflows.adaptation.with_twin import correction_of
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set, train
from edp.workflows.twin.prepare_twin import cut_recordings
from twin import QUICK_FIT, fitted_linkage

PROGRAMS = ("gcc", "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")

DRIVERS = ROOT / "tests/export"
DAY = 8_640_000
Rows = NDArray[np.float64]


FLAGS = ("-std=gnu99", "-O2", "-ffp-contract=off", "-I.")
WAYS = ("follower", "follower, adapted", "follower with thermometer", "follower with thermometer, adapted")
COLD_C = 20.0
"""Of the oil in the logs of the grey box."""


@dataclass(frozen=True)
class Size:
    """How much is simulated, trained and tried."""

    minutes: float
    recordings: int
    epochs: int
    updates: int
    tests: int
    test_minutes: float
    behind_s: float
    ticks: int
    grey: GreyFitSpec
    grey_recordings: int
    retrained: tuple[str, ...] = ()


GREY = GreyFitSpec(ticks=3000, starts=1, final_rounds=8)
SIZES = {
    "quick": Size(6.0, 14, 2, 30, 2, 1.2, 10.0, 60_000, QUICK_FIT, 6),
    "short": Size(60.0, 30, 12, 250, 3, 7.5, 60.0, 360_000, GREY, 18, ("clay",)),
    "full": Size(120.0, 60, 24, 250, 7, 17.5, 60.0, DAY, GREY, 18, ("oil 65 degrees", "clay", "dead band +3 points")),
}
"""Forms: under a minute or so; about eight processor minutes; everything."""


def machines(folder: Path) -> dict[str, tuple[str, str]]:
    """Machine file and soil of each scenario."""
    source = Path(machine_files.__file__).parents[1] / "machines" / "m22.toml"
    text, made = source.read_text(), {}
    cold = text.replace("temperature = 45.0", "temperature = 20.0")
    worn = cold.replace("[0.14, 0.13, 0.12]", "[0.17, 0.16, 0.15]").replace("[0.22, 0.22, 0.22]", "[0.25, 0.25, 0.25]")
    texts = {"cold": cold, "hot": text.replace("temperature = 45.0", "temperature = 65.0"), "worn": worn}
    if len({*texts.values(), text}) != 4:
        raise RuntimeError("m22.toml does not hold the numbers that are to be changed")
    for name, content in texts.items():
        path = folder / f"{name}.toml"
        path.write_text(content.replace('name = "M22"', f'name = "M22{name}"'))
        made[name] = str(path)
    return {
        "before": (made["cold"], ""),
        "oil 65 degrees": (made["hot"], ""),
        "clay": (made["cold"], "clay"),
        "dead band +3 points": (made["worn"], ""),
    }


def simulated(folder: Path, of: tuple[str, str], minutes: float, recordings: int, seed: int) -> DataSource:
    materials = {of[1]: 1.0} if of[1] else {}
    order = SimulationOrder(machine=of[0], minutes=minutes, recordings=recordings, seed=seed, materials=materials)
    simulate_data_set(folder, order, workers=IN_PROCESS)
    return DataSource.from_path(folder)


def trained(folder: Path, source: DataSource, size: Size, seed: int) -> Bundle:
    changes = [f"training.epochs={size.epochs}", f"training.updates={size.updates}", "training.loss.delta=0.1"]
    experiment = load_experiment(None, "quick", [*changes, "training.threads=1", f"training.seed={seed}"])
    return train(source, experiment, folder)


def unbounded(phi: Rows, errors: Rows, k: int, forgetting: float) -> Rows:
    """Corrections ``(time, target)`` by recursive least squares from errors that are known `k` ticks later."""
    n = phi.shape[1]
    theta, p, made = np.zeros((errors.shape[1], n)), np.eye(n), np.zeros_like(errors)
    for tick in range(len(phi)):
        if tick >= k:
            past = phi[tick - k]
            g = p @ past
            gain = g / (forgetting + past @ g)
            theta += np.outer(errors[tick - k] - theta @ past, gain)
            p = (p - np.outer(gain, g)) / forgetting
        made[tick] = theta @ phi[tick]
    return made


def rivals(predictor: Predictor, law: Adaptation, part: Series, base: Rows) -> dict[str, Rows]:
    """Predictions of the rivals, one horizon, ``(time, target)``."""
    k, present = law.horizons[0], part.targets.astype(float)
    errors = np.zeros_like(base)
    errors[:-k] = (present[k:] - base[:-k]) / law.unit[0]
    keep = float(law.numbers["keep"])
    change = (base - present) / law.change[0]
    gain = np.empty_like(base)
    for j in range(base.shape[1]):
        phi = np.stack([np.ones(len(base)), change[:, j]], axis=1)
        gain[:, j] = unbounded(phi, errors[:, j : j + 1], k, keep)[:, 0]
    hidden = stream_hidden(predictor, [part])[0].astype(float)
    whole = unbounded(np.concatenate([np.ones((len(hidden), 1)), hidden], axis=1), errors, k, keep)
    return {"offset and gain": base + law.unit[0] * gain, "full, no bounds": base + law.unit[0] * whole}


def scored(made: Rows, part: Series, law: Adaptation, window: int, behind_s: float) -> float:
    """MAE in mm/s behind so many seconds of motion, mean over targets."""
    k = law.horizons[0]
    known = (motion_s(law, part.targets)[:-k] >= behind_s) & (np.arange(len(part.targets) - k) >= window)
    return 1e3 * float(np.abs(made[:-k] - part.targets[k:])[known].mean())


def built(bundle: Bundle, folder: Path, driver: Path, *flags: str) -> None:
    """Export a network with its adaptation, and build a program around it."""
    CTarget().write(bundle, "predictor", folder)
    sources = make_model("predictor", bundle, adapts=True).sources
    given = ["-std=c99", "-O2", "-ffp-contract=off", "-I.", *flags, *sources, str(driver)]
    subprocess.run(["gcc", *given, "-lm", "-o", "program"], cwd=folder, check=True)


def driven(folder: Path, part: Series) -> tuple[Rows, Rows]:
    """Predictions of the C code without and with adaptation ``(time, target)``; they are the bits of the reference."""
    learning = np.ones((part.samples, 1), dtype=np.float32)
    feed = np.concatenate([part.inputs, learning], axis=1).astype(np.float32).tobytes()
    done = subprocess.run([folder / "program"], input=feed, check=True, capture_output=True)
    numbers = np.frombuffer(done.stdout, dtype=np.float32).reshape(part.samples, -1).astype(float)
    targets = part.targets.shape[1]
    return numbers[:, :targets], numbers[:, targets : 2 * targets]


def fitted_grey(recordings: Sequence[Recording], fit: GreyFitSpec, seed: int) -> tuple[GreyTwin, float]:
    """Fit a grey box of the machine before its change; return the twin and the processor seconds of the fit."""
    channels, data = cut_recordings(list(recordings), load_twin_experiment(None, ("twin.kind=greybox",)))
    return fitted_linkage((channels, fit_scales(channels, data.train), data), seed, fit)


@dataclass(frozen=True, eq=False)
class Follower:
    """The C code of a follower, compiled.

    Attributes:
        parts: what it is made of.
        folder: of the program.
    """

    parts: FollowerParts
    folder: Path

    @staticmethod
    def built(twin: GreyTwin, bundle: Bundle, law: Adaptation, folder: Path) -> Follower:
        """Write and compile it; its self-test must pass."""
        spec = TunedSpec(oil_c=COLD_C)
        limit = correction_of(twin, law, bundle.task, spec).limit
        parts = FollowerParts("a grey box", twin, spec, bundle.task.targets, law.horizons, limit)
        write_follower(parts, plant_bundle(TwinBundle(twin.spec, twin)), "follower", folder)
        made = Follower(parts, folder)
        run(["gcc", *FLAGS, *listed_sources(folder), "host_test.c", "-lm", "-o", "program"], folder)
        print(run(["./program"], folder).strip())
        return made

    def moved(self, recording: Recording, base: Rows, measured_oil: bool) -> tuple[Rows, Rows]:
        """Predictions of one horizon, moved ``(time, target)``, and factors of the groups at the end."""
        part = self.parts.twin.channels.task().series(recording)
        oil = oil_celsius(recording) if measured_oil else np.full(part.samples, np.nan)
        rows = np.concatenate([part.inputs, part.targets, oil[:, None], base], axis=1).astype(np.float32)
        done = subprocess.run(
            [self.folder / "program", "stream", "1000"], input=rows.tobytes(), check=True, capture_output=True
        )
        numbers = np.frombuffer(done.stdout, np.float32).reshape(part.samples, -1).astype(float)
        targets = base.shape[1]
        return numbers[:, :targets], numbers[-1, targets + len(self.parts.twin.channels.velocities) : -1]

    def ways(self, recording: Recording, series: Series, base: Rows, law: Adaptation, warm: int) -> dict[str, Any]:
        """Predictions of each of `WAYS`, and the factors that were found."""
        found: dict[str, Any] = {}
        for way, measured in (("follower", False), ("follower with thermometer", True)):
            found[way], factors = self.moved(recording, base, measured)
            found[f"{way}, adapted"] = linear(law, series, found[way], warm)
            found[f"factors, {way}"] = factors
        return found

    def cost(self) -> dict[str, int]:
        """Instructions of a tick on a Cortex-M7 with one run of a stretch a tick, and bytes."""
        skipped = self.parts.twin.prefix_ticks + 2 * self.parts.spec.learn_ticks
        sources = listed_sources(self.folder)
        build_image(self.folder, M7, [*sources, BOARD / "follow.c"], "-DRUNS=1u", f"-DSKIPPED={skipped}u")
        mean, most, *_ = run_image(self.folder, QEMU_M7)
        flash, state = sizes_on_m7(self.folder, sources, "follower.h", "follower_state")
        return {
            "instructions": int(mean), "most_instructions": int(most), "flash_bytes": flash, "state_bytes": state,
            "golden_ticks": GOLDEN_TICKS,
        }  # fmt: skip


def linear(law: Adaptation, series: Series, base: Rows, warm: int) -> Rows:
    """Predictions ``(time, target)`` behind the linear correction, which learns from what the follower leaves."""
    adapter, made = RlsCorrector(law), np.empty_like(base)
    for tick, (x, y) in enumerate(zip(series.inputs, base.astype(np.float32), strict=True)):
        made[tick] = adapter.step(x, y[None], fresh=tick + 1 >= warm)[0][0]
    return made


@dataclass(frozen=True, eq=False)
class Recovered:
    """MAE of each way by scenario, mean over recordings and each, and factors that the follower found at the end."""

    mae: dict[str, dict[str, float]]
    each: dict[str, dict[str, list[float]]]
    factors: dict[str, dict[str, list[dict[str, float]]]]


def recovery(
    bundle: Bundle, law: Adaptation, tests: dict[str, DataSource], folder: Path, follower: Follower, behind_s: float
) -> Recovered:
    """Measure every adaptation method on the scenarios; `folder` holds the program of network and correction."""
    predictor, window = bundle.predictor, bundle.predictor.spec.window
    result, labels = Recovered({}, {}, {}), follower.parts.correction().tuned.labels
    for name, source in tests.items():
        rows: dict[str, list[float]] = {}
        factors: dict[str, list[dict[str, float]]] = {}
        for recording in source.read():
            part = bundle.task.series(recording)
            base, adapted = driven(folder, part)
            followed = follower.ways(recording, part, base, law, window)
            ways = {"frozen": base, "adapted": adapted} | {way: followed[way] for way in WAYS}
            for way, made in (ways | rivals(predictor, law, part, base)).items():
                rows.setdefault(way, []).append(scored(made, part, law, window, behind_s))
            for way in ("follower", "follower with thermometer"):
                numbers = [round(float(x), 3) for x in followed[f"factors, {way}"]]
                factors.setdefault(way, []).append(dict(zip(labels, numbers, strict=True)))
        result.each[name], result.factors[name] = rows, factors
        result.mae[name] = {way: float(np.mean(values)) for way, values in rows.items()}
        print(name, {way: round(value, 3) for way, value in result.mae[name].items()}, flush=True)
    return result


def frozen_mae(bundle: Bundle, law: Adaptation, source: DataSource, behind_s: float) -> float:
    series = [bundle.task.series(recording) for recording in source.read()]
    made = stream_predictions(bundle.predictor, series)
    window, pairs = bundle.predictor.spec.window, zip(made, series, strict=True)
    return float(np.mean([scored(y[:, 0].astype(float), s, law, window, behind_s) for y, s in pairs]))


def instructions(bundle: Bundle) -> tuple[int, int]:
    """Instructions of a tick without and with adaptation, behind a whole window; mean of 100 ticks."""
    counted = []
    adapted = PROGRAM.replace('#include "predictor.h"', '#include "predictor_adaptation.h"')
    adapted = adapted.replace(
        "static predictor_output out;", "static predictor_output out; static predictor_adaptation a;"
    )
    adapted = adapted.replace("predictor_reset(&state);", "predictor_reset(&state); predictor_adapt_reset(&a);")
    call = "(void)predictor_step(&state, golden_inputs[tick], &out);"
    adapted = adapted.replace(call, call + " (void)predictor_adapt(&a, &state, true, &out, &out);")
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        CTarget().write(bundle, "predictor", folder)
        sources = make_model("predictor", bundle, adapts=True).sources
        for program in (PROGRAM, adapted):
            (folder / "ticks.c").write_text(program)
            flags = (f"-DTICKS={bundle.predictor.spec.window + 20}u", "-DCOUNTED=20u")
            counted.append(int(on_board(folder, ("ticks.c", *sources), *flags)[0]))
    return counted[0], counted[1]


def narrow(bundle: Bundle, seed: int) -> Bundle:
    """Create a narrow untrained network with the inputs, scaling and adaptation of a bundle."""
    predictor = bundle.predictor
    numbers = (predictor.front.offset, predictor.front.width, predictor.code.offset, predictor.code.width)
    scaler = Scaler(*(part.detach().double().numpy() for part in numbers))
    spec = replace(predictor.spec, backbone=HybridSpec(channels=(8,), kernel=3, units=8), blocks=(), window=10)
    return replace(bundle, predictor=build_model(predictor.task, spec, scaler, seed).eval())


def attacked(bundle: Bundle, bank: NDArray[np.float32], ticks: int) -> list[float]:
    """Run the adversarial program and return the numbers that it prints."""
    law = bundle.adaptation
    if law is None:
        raise RuntimeError("the bundle has no adaptation")
    named = {"COLUMNS": ",".join(map(str, law.columns)), "AHEAD": ",".join(map(str, law.horizons))}
    named |= {"MOST_AHEAD": f"{law.max_horizon}u", "BOUND": f"{law.numbers['bound']:.9g}f"}
    flags = [f"-D{name}={value}" for name, value in named.items()]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        built(bundle, folder, DRIVERS / "adversary.c", *flags)
        feed = np.ascontiguousarray(bank, dtype=np.float32).tobytes()
        done = subprocess.run([folder / "program", str(ticks)], input=feed, check=True, capture_output=True)
    return [float(word) for word in done.stdout.split()]


@benchmark(
    DATA_AND_PARTS,
    option("--short", action="store_true", help="60 min, three recordings, an hour of the adversary"),
    programs=PROGRAMS,
)
def main(bench: Bench) -> object:
    form = "quick" if bench.quick else "short" if bench.options.short else "full"
    folder, seed, size, cases = bench.folder, bench.seed, SIZES[form], machines(bench.folder)
    bundle, law, grey = prepared(folder, cases["before"], size, seed)
    tests = {
        name: simulated(folder / f"test {name}", case, size.test_minutes, size.tests, seed + 90)
        for name, case in cases.items()
    }
    with tempfile.TemporaryDirectory() as temporary:
        program = make_folder(Path(temporary) / "network")
        built(bundle, program, DRIVERS / "adaptation_driver.c")
        follower = Follower.built(grey, bundle, law, Path(temporary) / "follower")
        found = recovery(bundle, law, tests, program, follower, size.behind_s)
        cost = follower.cost()
    print(f"a tick of the follower on a Cortex-M7: {cost}")
    attainable = retrained(folder, cases, tests, (size, law, seed))
    check_recovered(bench, found.mae)
    check_followers(bench, found.mae, attainable)
    adversary = check_costs_and_attacks(bench, bundle, tests["before"], size.ticks)
    return {
        "form": form, "mae": found.mae, "each": found.each, "factors": found.factors, "options": law.to_dict(),
        "follower on a Cortex-M7": cost, "trained after the change": attainable, "adversary": adversary,
    }  # fmt: skip


def prepared(folder: Path, before: tuple[str, str], size: Size, seed: int) -> tuple[Bundle, Adaptation, GreyTwin]:
    """Network with its adaptation, and grey box, of the machine before its change; what a run has left is read."""
    if not holds_twin(folder / "grey"):
        source = simulated(folder / "source", before, size.minutes, size.recordings, seed + 1)
        network = trained(folder / "network", source, size, seed)
        experiment = load_experiment(folder / "network" / "config.toml", None)
        law = fit_adaptation(network.predictor, prepare_data(source, experiment), AdaptationSpec())
        save_bundle(replace(network, adaptation=law), folder / "adapted")
        grey, seconds = fitted_grey(source.read()[: size.grey_recordings], size.grey, seed)
        print(f"grey box fitted in {seconds:.0f} processor s", flush=True)
        save_twin(TwinBundle(grey.spec, grey), folder / "grey")
    bundle, twin = load_bundle(folder / "adapted"), load_twin(folder / "grey").twin
    if bundle.adaptation is None or not isinstance(twin, GreyTwin):
        raise RuntimeError(f"{folder} holds other models than this benchmark leaves there")
    return bundle, bundle.adaptation, twin


def retrained(
    folder: Path, cases: dict[str, tuple[str, str]], tests: dict[str, DataSource], how: tuple[Size, Adaptation, int]
) -> dict[str, float]:
    """MAE of networks that were trained after the change alone, by scenario."""
    (size, law, seed), attainable = how, {}
    for name in size.retrained:
        taught = simulated(folder / f"changed {name}", cases[name], size.minutes, size.recordings, seed + 3)
        own = frozen_mae(trained(folder / f"network {name}", taught, size, seed), law, tests[name], size.behind_s)
        attainable[name] = own
        print(f"{name}: a network trained after the change alone has an MAE of {own:.3f} mm/s there", flush=True)
    return attainable


def check_costs_and_attacks(bench: Bench, bundle: Bundle, bank_of: DataSource, ticks: int) -> dict[str, Any]:
    """Instructions of a tick, and what an adversary does to the correction; returns the latter."""
    without, with_ = instructions(bundle)
    bench.check("instructions per sample, with adaptation against without", with_, without, "<= 1.1", "1")
    bank = bundle.task.series(bank_of.read()[0]).inputs
    names = ("corrected", "worst", "not_finite", "repairs", "beyond", "without", "with", "worst_turn", "taken_back")
    attack = dict(zip(names, attacked(narrow(bundle, bench.seed), bank, ticks), strict=True))
    print(f"adversary, {ticks / 360_000:g} h: {attack}")
    wrong = attack["not_finite"] + attack["repairs"] + attack["beyond"]
    bench.check("faults under adversarial inputs", wrong, 1.0, "<= 0", "faults")
    bench.check("largest correction relative to its limit", attack["worst"], 1.0, "<= 1.000001", "1")
    name = "error under adversarial inputs, with adaptation against without"
    bench.check(name, attack["with"], attack["without"], "<= 1.05", "units")
    return attack | {"ticks": ticks}


def check_followers(bench: Bench, found: dict[str, dict[str, float]], attainable: dict[str, float]) -> None:
    """Of the loss that a change is to the network, what the follower has not; in clay, over what training wins."""
    before = found["before"]
    for name, ways in found.items():
        if name not in ("before", "clay"):
            loss = ways["frozen"] - before["frozen"]
            for way in ("follower, adapted", "follower with thermometer, adapted"):
                left = loss - (ways[way] - before[way])
                bench.check(
                    f"{name}: {way}: recovered loss of the change alone", left, loss, ">= 0.5", "mm/s recovered"
                )
        elif name in attainable:
            won, wanted = ways["frozen"] - ways["follower, adapted"], ways["frozen"] - attainable[name]
            bench.check(
                "clay: follower, adapted: gain relative to training in clay", won, wanted, ">= 0.8", "mm/s recovered"
            )


def check_recovered(bench: Bench, found: dict[str, dict[str, float]]) -> None:
    """Add one verdict for each change; the table shows all methods."""
    before, rows = found["before"], []
    for name, ways in found.items():
        loss = ways["frozen"] - before["frozen"]
        for way, mae in ways.items():
            gained = ways["frozen"] - mae
            change = loss - (mae - before[way])
            # A short form may drive where a change is not met: in clay, without a dig.
            shares = (gained / loss, change / loss) if loss else ("", "")
            rows.append([name, way, mae, *shares])
        if loss:
            gained = ways["frozen"] - ways["adapted"]
            bench.check(f"{name}: recovered loss, linear correction", gained, loss, ">= 0.5", "mm/s recovered")
    table(["scenario", "way", "MAE mm/s", "recovered", "of the change"], rows)


if __name__ == "__main__":
    main()
