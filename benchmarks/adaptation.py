"""Does the on-board adaptation win back what a step change of the machine costs, at little cost, and never diverge?

A network of M22 with cold oil (20 degrees, free air) meets three changes: oil at 65 degrees, clay, and dead bands that
are 3 points wider. The same scenarios (same seeds of the operator) are run on the machine before and after; each
recording starts with nothing learned. The loss is the MAE of the frozen network after the change less its MAE before,
on the ticks behind 60 s of motion, k = 10, mean over cylinders; what is recovered is the share of it by which the
adapted network is better than the frozen one on the same ticks. An adaptation that helps the unchanged machine as well
recovers more than the change has cost: so the gain before is shown, and the share without it ("of the change").
A change makes the future harder to know for any predictor: how much is shown by networks trained after it.

The options' defaults were chosen on other recordings of these scenarios (seed 50) than those that count here (seed 90).

A grey box of the machine as it was follows the machine, too (`adaptation_follower.py`, the C code of `edp export --to
follower`), alone and before the correction above, without and with a thermometer in the oil.

Rivals on the same ticks: no adaptation; offset and gain of each predicted change, by recursive least squares; the whole
last layer's features by recursive least squares with forgetting and no bounds, from the backbone's representation.

Cost: instructions of a tick on an emulated Cortex-M4F, with and without `adapt`. Divergence: the C code for 24 h under
an adversary (tests/export/adversary.c), around a narrow network with weights as drawn, so that a day takes a minute: an
adaptation sees inputs and predictions only, and those of such a network are worse.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from adaptation_follower import WAYS, Follower, fitted_grey
from common import Verdict, finish, parser, table, verdict
from controller_cycles import PROGRAM
from edp.config.experiment import load_experiment
from edp.data.scaling import Scaler
from edp.data.series import Series
from edp.export.c.model import make_model
from edp.export.c.target import CTarget
from edp.ir.rls import Adaptation, AdaptationSpec
from edp.networks.backbones import HybridSpec
from edp.networks.predictor import Predictor, build_model
from edp.networks.running import stream_hidden, stream_predictions
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.greybox import GreyTwin
from edp.sim.machine import machine_files
from edp.training import load_bundle, save_bundle
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle, holds_twin, load_twin, save_twin
from edp.workflows.adaptation import fit_adaptation, motion_s
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set, train
from embedded_step import on_board
from twin import QUICK_FIT

PROGRAMS = ("gcc", "arm-none-eabi-gcc", "arm-none-eabi-size", "qemu-system-arm")

DRIVERS = Path(__file__).parents[1] / "tests/export"
DAY = 8_640_000
Rows = NDArray[np.float64]


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
    simulate_data_set(folder, order, workers=1)
    return DataSource.of(folder)


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


@dataclass(frozen=True, eq=False)
class Recovered:
    """MAE of each way by scenario, mean over recordings and each, and factors that the follower found at the end."""

    mae: dict[str, dict[str, float]]
    each: dict[str, dict[str, list[float]]]
    factors: dict[str, dict[str, list[dict[str, float]]]]


def recovery(
    bundle: Bundle, law: Adaptation, tests: dict[str, DataSource], folder: Path, follower: Follower, behind_s: float
) -> Recovered:
    """What every way makes of the scenarios; `folder` holds the program of network and correction."""
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
    """The same inputs, scaling and adaptation around a narrow network with weights as drawn."""
    predictor = bundle.predictor
    numbers = (predictor.front.offset, predictor.front.width, predictor.code.offset, predictor.code.width)
    scaler = Scaler(*(part.detach().double().numpy() for part in numbers))
    spec = replace(predictor.spec, backbone=HybridSpec(channels=(8,), kernel=3, units=8), blocks=(), window=10)
    return replace(bundle, predictor=build_model(predictor.task, spec, scaler, seed).eval())


def attacked(bundle: Bundle, bank: NDArray[np.float32], ticks: int) -> list[float]:
    """What the adversary prints."""
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


def main() -> None:
    arguments_of = parser(__doc__ or "", PROGRAMS)
    arguments_of.add_argument("--short", action="store_true", help="60 min, three recordings, an hour of the adversary")
    arguments = arguments_of.parse_args()
    form = "quick" if arguments.quick else "short" if arguments.short else "full"
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.data or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        study(folder, form, arguments.seed)


def study(folder: Path, form: str, seed: int) -> None:
    size, quick, cases = SIZES[form], form == "quick", machines(folder)
    bundle, law, grey = prepared(folder, cases["before"], size, seed)
    tests = {
        name: simulated(folder / f"test {name}", case, size.test_minutes, size.tests, seed + 90)
        for name, case in cases.items()
    }
    with tempfile.TemporaryDirectory() as temporary:
        program = Path(temporary) / "network"
        program.mkdir()
        built(bundle, program, DRIVERS / "adaptation_driver.c")
        follower = Follower.built(grey, bundle, law, Path(temporary) / "follower")
        found = recovery(bundle, law, tests, program, follower, size.behind_s)
        cost = follower.cost()
    print(f"a tick of the follower on a Cortex-M7: {cost}")
    attainable = retrained(folder, cases, tests, (size, law, seed))
    details = {
        "form": form, "mae": found.mae, "each": found.each, "factors": found.factors, "options": law.to_plain(),
        "follower on a Cortex-M7": cost, "trained after the change": attainable,
    }  # fmt: skip
    verdicts = [*judged(found.mae, quick), *judged_followers(found.mae, attainable, quick)]
    verdicts += costs_and_attacks(bundle, tests["before"], (size, seed, quick), details)
    finish("adaptation", verdicts, seed, details)


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


def costs_and_attacks(
    bundle: Bundle, bank_of: DataSource, how: tuple[Size, int, bool], details: dict[str, Any]
) -> list[Verdict]:
    """Instructions of a tick, and what an adversary does to the correction; written into `details`, too."""
    size, seed, quick = how
    without, with_ = instructions(bundle)
    verdicts = [verdict("instructions of a tick, with over without", with_, without, "<= 1.1", "1", quick)]
    bank = bundle.task.series(bank_of.read()[0]).inputs
    names = ("corrected", "worst", "not_finite", "repairs", "beyond", "without", "with", "worst_turn", "taken_back")
    attack = dict(zip(names, attacked(narrow(bundle, seed), bank, size.ticks), strict=True))
    details["adversary"] = attack | {"ticks": size.ticks}
    print(f"adversary, {size.ticks / 360_000:g} h: {attack}")
    wrong = attack["not_finite"] + attack["repairs"] + attack["beyond"]
    verdicts.append(verdict("faults under the adversary, against one", wrong, 1.0, "<= 0", "faults", quick))
    verdicts.append(verdict("largest correction over its limit", attack["worst"], 1.0, "<= 1.000001", "1", quick))
    verdicts.append(verdict("error under the adversary, with over without", attack["with"], attack["without"],
                            "<= 1.05", "units", quick))  # fmt: skip
    return verdicts


def judged_followers(found: dict[str, dict[str, float]], attainable: dict[str, float], quick: bool) -> list[Verdict]:
    """Of the loss that a change is to the network, what the follower has not; in clay, over what training wins."""
    verdicts, before = [], found["before"]
    for name, ways in found.items():
        if name not in ("before", "clay"):
            loss = ways["frozen"] - before["frozen"]
            for way in ("follower, adapted", "follower with thermometer, adapted"):
                kept = loss - (ways[way] - before[way])
                question = f"{name}: {way}: of the change alone"
                verdicts.append(verdict(question, kept, loss, ">= 0.5", "mm/s recovered", quick))
        elif name in attainable:
            won = ways["frozen"] - ways["follower, adapted"]
            verdicts.append(verdict("clay: follower, adapted: over what training wins", won,
                                    ways["frozen"] - attainable[name], ">= 0.8", "mm/s recovered", quick))  # fmt: skip
    return verdicts


def judged(found: dict[str, dict[str, float]], quick: bool) -> list[Verdict]:
    """A verdict a change; the table shows all ways."""
    before, verdicts, rows = found["before"], [], []
    for name, ways in found.items():
        loss = ways["frozen"] - before["frozen"]
        for way, mae in ways.items():
            gained = ways["frozen"] - mae
            change = loss - (mae - before[way])
            # A short form may drive where a change is not met: in clay, without a dig.
            shares = (gained / loss, change / loss) if loss else ("", "")
            rows.append([name, way, mae, *shares])
        if loss:
            verdicts.append(verdict(f"{name}: recovered of the loss", ways["frozen"] - ways["adapted"], loss,
                                    ">= 0.5", "mm/s recovered", quick))  # fmt: skip
    table(["scenario", "way", "MAE mm/s", "recovered", "of the change"], rows)
    sys.stdout.flush()
    return verdicts


if __name__ == "__main__":
    main()
