"""How far off is a twin that runs free for a minute, beside the static valve map, ARX and N4SID in the same run?

Machine M22 in free air, recordings that no training saw: a short measured prefix, then 60 s on commands alone. Goals
are asked of the formulation, network or grey box, that has less error on the validation part. One grey box is told the
linkage, beside bodies that are 10 to 50 % off those of the machine. With --only some of these are fitted, and the
questions of the others are left out. With --specialist it also asks whether one set of weights for all modes is as good
as one that was only ever run free, and as one that only ever looked 0.1 s ahead.
"""

from __future__ import annotations

import json
import tempfile
import time
import tomllib
from collections.abc import Callable
from dataclasses import replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w
import torch

from common import DATA, Bench, benchmark, option, table
from edp.config.twin import TwinExperiment, load_twin_experiment
from edp.evaluation.ahead import look_ahead, score_ahead
from edp.evaluation.free_run import calibrated, free_run_scores, free_runs
from edp.logs.source import DataSource
from edp.networks.twin import TWINS, Twin, fit_scales
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.greybox import GreyBox, GreyTwin
from edp.networks.twin.recurrent import RecurrentTwin
from edp.networks.twin.recurrent_cell import TwinNetwork
from edp.networks.twin.windows import MeasuredWindows, random_windows
from edp.settings.results import plain_value
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.testing.twin_cell import plain_steps
from edp.training.blas import one_blas_thread
from edp.training.fitted_twin import FreeRunProgress
from edp.training.free_run import FreeRunSpec, fit_free_runs
from edp.training.grey_fit import fit_grey_box
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin
from edp.workflows.twin.train_twin import prepare_twin

AHEAD = 10
"""Ticks that a measured twin looks ahead, told the commands in between."""
FREE_ONLY, AHEAD_ONLY = "recurrent, free lanes only", "recurrent, looks ahead only"
PARTS = ("velocities", "strokes", "pressures")
LINKED = "greybox, linkage told"
FITTED = ("recurrent", "greybox", LINKED)
"""Formulations that are trained on free runs and asked the goals; the others are floors."""
RECURRENT = ("twin.kind=recurrent",)
WRONG = {
    "mass": (1.25, 0.8, 1.3), "com_x": (0.9, 1.1, 0.85), "com_y": (0.8, 1.2, 1.2), "inertia": (0.7, 1.4, 1.5),
}  # fmt: skip
"""Factors on the bodies of the machine file that names the linkage: a tape measure does not find them."""
DEFAULT_FIT = GreyFitSpec()
QUICK_FIT = GreyFitSpec(lengths_s=(0.1, 0.3), rounds=(1, 1), final_rounds=1, ticks=1000, starts=1)
MANY = 1000
"""Free runs in which those that diverge are counted."""
VALIDATION_S = 10.0
"""Length of the free runs by which one of them is chosen: that of the validation in a training."""


@benchmark(
    DATA,
    option("--specialist", action="store_true", help="train a second one, which takes as long"),
    option("--only", nargs="+", choices=FITTED, default=FITTED),
    option("--minutes", type=float, default=180.0, help="of recordings of 3 min each"),
    option("--ticks", type=int, default=DEFAULT_FIT.ticks, help="of a round of a grey box's fit"),
    option("--many", action="store_true", help=f"only the share of diverged ones of {MANY} runs"),
    option("--kept", type=Path, help="folder of what was fitted: read where there, else written"),
    option("--starts", type=int, default=DEFAULT_FIT.starts, help="of a grey box's fit"),
    option("--final-rounds", type=int, default=DEFAULT_FIT.final_rounds, help="of a grey box's fit"),
    option("--final-memory", type=float, default=DEFAULT_FIT.final_memory,
           help="share of what such a round knows that counts in the next one"),
)  # fmt: skip
def main(bench: Bench) -> object:
    arguments, quick, only = bench.options, bench.quick, bench.options.only
    if arguments.specialist and "recurrent" not in only:
        raise SystemExit("--specialist is asked of the recurrent twin: --only must name it")
    experiment = load_twin_experiment(None, RECURRENT)
    minutes, count = (10.0, 8) if quick else (arguments.minutes, round(arguments.minutes / 3))
    simulate_data_set(bench.data, SimulationOrder(minutes=minutes, recordings=count, seed=bench.seed + 1))
    channels, data = prepare_twin(DataSource.from_path(bench.data), experiment)
    parts = channels, fit_scales(channels, data.train), data
    whole = set(only) == set(FITTED)
    closed = (*experiment.evaluation.floors, "n4sid") if whole else ("static",) if not arguments.many else ()
    models = floors(closed, parts, bench.seed) | fitted_models(arguments, experiment, parts)
    if arguments.many:
        least = 60 if quick else MANY
        many = {name: diverged_of_many(twin, data.test, least) for name, (twin, _) in models.items()}
        for name, row in many.items():
            bench.check(f"diverged of {row['runs']} runs, {name}", row["diverged"], 1e-3, "<= 1", "share")
        bench.name = "twin_many"
        return many
    scores = scored(models, closed, parts, experiment, 3 if quick else 16)
    show(scores)
    check_goals(bench, scores, [name for name in FITTED if name in only], experiment.evaluation.coverage)
    if "recurrent" in only:
        compiled, plain = (update_ms(experiment, parts, how) for how in (TwinNetwork.forward, plain_steps))
        name = "forward and backward pass, 100 samples, batch of 64: compiled loop against autograd"
        bench.check(name, compiled, plain, "<= 0.5", "ms")
    if arguments.specialist:
        check_specialist(bench, scores)
    bench.name = "twin_specialist" if arguments.specialist else "twin" if whole else "twin_part"
    return scores


def floors(names: tuple[str, ...], parts: Any, seed: int) -> dict[str, tuple[Twin, float]]:
    """Models that need no training."""
    channels, scales, data = parts
    # The validation part chose among weights of the others; what needs no choice has it to learn from.
    everything = [*data.train, *data.validation]
    return {name: (TWINS[name]().start(channels, scales, everything, seed), 0.0) for name in names}


def fitted_models(arguments: Any, experiment: TwinExperiment, parts: Any) -> dict[str, tuple[Twin, float]]:
    """Fit the requested twins; return each with the processor seconds of its training."""
    quick, only, seed = arguments.quick, arguments.only, arguments.seed
    fit = QUICK_FIT if quick else grey_fit(arguments)
    training = replace(experiment.training, seed=seed)
    if quick:
        training = replace(training, lengths_s=(0.1, 0.5, 2.0), updates=(60, 40, 16), validate_every=40)
    models: dict[str, tuple[Twin, float]] = {}

    def network(name: str, how: FreeRunSpec) -> tuple[Twin, float]:
        return fitted_once(arguments.kept, name, trained, (experiment, how, parts), experiment.twin)

    if "recurrent" in only:
        models["recurrent"] = network("recurrent", training)
    for name, fitted in (("greybox", fitted_grey_box), (LINKED, fitted_linkage)):
        if name in only:
            print(f"fitting: {name}", flush=True)
            models[name] = fitted_once(arguments.kept, name, fitted, (parts, seed, fit))
    if arguments.specialist:
        free_only = replace(training, measured_fraction=0.0, mixed_fraction=0.0)
        models[FREE_ONLY] = network(FREE_ONLY, free_only)
        # As many updates, all on runs as long as a look ahead: it is told the commands in between, as the twin is.
        short = replace(training, lengths_s=(AHEAD / parts[0].rate_hz,), updates=(sum(training.updates),))
        models[AHEAD_ONLY] = network(AHEAD_ONLY, short)
    return models


def scored(
    models: dict[str, tuple[Twin, float]], closed: tuple[str, ...], parts: Any, experiment: TwinExperiment, starts: int
) -> dict[str, dict[str, Any]]:
    """Errors of free runs of a minute in each test recording and of a look ahead; intervals of all that is fitted."""
    data, scores = parts[2], {}
    for name, (twin, seconds) in models.items():
        taught = name not in closed
        intervals = calibrated([(twin, data.validation)], experiment.evaluation) if taught else None
        own = free_run_scores(free_runs(twin, data.test, 60.0, starts), experiment.evaluation, intervals)
        scores[name] = plain_value(replace(own, ahead=score_ahead(look_ahead(twin, data.test, AHEAD))))
        scores[name]["training_s"] = seconds
        if taught:
            scores[name]["validation_mae"] = validation_mae(twin, data, experiment)
    return scores


def validation_mae(twin: Twin, data: Any, experiment: TwinExperiment) -> float:
    """Error of the velocities over free runs of the validation part, mm/s, by which formulations are chosen."""
    runs = free_runs(twin, data.validation, VALIDATION_S, 4)
    return float(free_run_scores(runs, experiment.evaluation).velocity_mae.mean or 0.0)


def check_goals(bench: Bench, scores: dict[str, dict[str, Any]], named: list[str], coverage: float) -> None:
    """Add the verdicts for the formulation with the smaller validation error."""
    best = min(named, key=lambda name: scores[name]["validation_mae"])
    print(f"less error on the validation part: {best}")
    ours, rival = scores[best], scores["static"]
    last, floor = (row["stroke_error"][-1]["mean"] for row in (ours, rival))
    shares = [row[part]["share"] for row in ours["intervals"]["at"] for part in PARTS]
    worst = max(abs(share - coverage) for share in shares)
    bench.check("stroke error at 60 s against the static map", last, floor, "<= 0.04", "mm")
    bench.check("stroke error at 60 s", last, 3.0, "<= 1", "mm")
    bench.check("velocity MAE over 60 s", ours["velocity_mae"]["mean"], 1.5, "<= 1", "mm/s")
    bench.check("pressure NRMSE over 60 s", ours["pressure_nrmse"]["mean"], 0.15, "<= 1", "1")
    bench.check("diverged runs", ours["diverged"], 1e-3, "<= 1", "share")
    bench.check("processor time of the training", ours["training_s"], 1200.0, "<= 1", "s")
    bench.check("intervals at 0.1, 1, 10, 60 s: largest deviation from 90 %", worst, 0.05, "<= 1", "share")


def diverged_of_many(twin: Twin, test: Any, least: int) -> dict[str, Any]:
    """Share of diverged runs among at least so many, evenly spread over the recordings; a recording at a time."""
    starts = -(-least // len(test))
    gone = np.concatenate([free_runs(twin, [series], 60.0, starts).diverged() for series in test])
    return {"runs": len(gone), "diverged": float(gone.mean())}


def check_specialist(bench: Bench, scores: dict[str, Any]) -> None:
    """One set of weights for all modes against one that was made for each."""
    free, special = (scores[name]["velocity_mae"]["mean"] for name in ("recurrent", FREE_ONLY))
    ahead, other = (scores[name]["ahead"]["velocity_mae"]["mean"] for name in ("recurrent", AHEAD_ONLY))
    bench.check(
        "one network for all modes, free-run simulation, against a specialist", free, special, "<= 1.05", "mm/s"
    )
    name = f"one network for all modes, {AHEAD} samples ahead, against a specialist"
    bench.check(name, ahead, other, "<= 1.05", "mm/s")


def trained(experiment: TwinExperiment, training: FreeRunSpec, parts: Any) -> tuple[RecurrentTwin, float]:
    """Train a recurrent twin; return the twin and its processor seconds."""
    channels, scales, data = parts
    formulation: Any = experiment.twin  # RECURRENT says which
    twin: RecurrentTwin = formulation.start(channels, scales, data.train, training.seed)
    fitted = fit_free_runs(twin, data.train, data.validation, training, told)
    return twin, fitted.seconds


def grey_fit(arguments: Any) -> GreyFitSpec:
    """How grey boxes are fitted."""
    spec = GreyFitSpec(ticks=arguments.ticks, starts=arguments.starts)
    return replace(spec, final_rounds=arguments.final_rounds, final_memory=arguments.final_memory)


def fitted_once(
    folder: Path | None, name: str, fitted: Callable[..., Any], how: tuple[Any, ...], spec: Any = None
) -> tuple[Twin, float]:
    """Fit a twin, resuming an interrupted run of the folder; return the twin and its processor seconds."""
    if folder is None:
        return fitted(*how)
    home = folder / name.replace(", ", "_").replace(" ", "_")
    if not (home / "seconds.json").exists():
        twin, seconds = fitted(*how)
        save_twin(TwinBundle(spec or twin.spec, twin), home)
        (home / "seconds.json").write_text(json.dumps(seconds), encoding="utf-8")
    return load_twin(home).twin, json.loads((home / "seconds.json").read_text(encoding="utf-8"))


def fitted_linkage(parts: Any, seed: int, fit: GreyFitSpec) -> tuple[GreyTwin, float]:
    """Fit a grey box with the known linkage of M22 and wrong body parameters."""
    with tempfile.TemporaryDirectory() as folder:
        return fitted_grey_box(parts, seed, fit, write_guess("m22", Path(folder) / "guess.toml"))


def write_guess(machine: str, path: Path) -> str:
    """Write the file of a machine with its linkage and bodies that are not its own; returns the path."""
    table = tomllib.loads((resources.files("edp.sim") / "machines" / f"{machine}.toml").read_text(encoding="utf-8"))
    for key, factors in WRONG.items():
        table["bodies"][key] = [value * factor for value, factor in zip(table["bodies"][key], factors, strict=True)]
    path.write_text(tomli_w.dumps(table), encoding="utf-8")
    return str(path)


def fitted_grey_box(parts: Any, seed: int, settings: GreyFitSpec, linkage: str = "") -> tuple[GreyTwin, float]:
    """Fit a grey box; return the twin and its processor seconds. A known linkage uses the machine's channels."""
    channels, scales, data = parts
    twin = GreyBox(fit=settings, linkage=linkage).start(channels, scales, data.train, seed)
    fit = fit_grey_box(twin, data.train, data.validation, seed, told)
    return fit.twin, fit.seconds


def told(event: FreeRunProgress) -> None:
    """Print a validation on the way."""
    text = f"update {event.update}/{event.updates}, {event.length_s:g} s, validation {event.validation:.4f}"
    print(text, flush=True)


def update_ms(experiment: TwinExperiment, parts: Any, how: Callable[..., Any]) -> float:
    """Processor time of values and gradients of free runs of 100 ticks in 64 lanes; the least of several."""
    channels, scales, data = parts
    formulation: Any = experiment.twin  # RECURRENT says which
    twin: RecurrentTwin = formulation.start(channels, scales, data.train, 0)
    scaled = [replace(part, inputs=twin.drive(part.inputs), targets=twin.scaled(part.targets)) for part in data.train]
    windows = MeasuredWindows.read(random_windows(scaled, 100, 64, np.random.default_rng(0)), 100)
    commands, truth = (torch.tensor(v.swapaxes(0, 1)) for v in (windows.commands, windows.outputs[:, :-1]))
    port, start = torch.zeros_like(truth), (truth[0], torch.zeros(64, twin.network.units))
    spent = []
    # As a training runs: idle threads of the linear algebra library would spin, and count, in both ways.
    with one_blas_thread():
        for _ in range(5):
            began = time.process_time()
            answers, _ = how(twin.network, commands, truth, port, start, twin.bounds)
            answers.square().sum().backward()
            spent.append(time.process_time() - began)
    return 1e3 * min(spent)


def show(scores: dict[str, dict[str, Any]]) -> None:
    """Print a row a model."""
    first = next(iter(scores.values()))
    heads = ["model", "velocity MAE, mm/s", *(f"stroke at {row['at_s']:g} s, mm" for row in first["stroke_error"])]
    heads += ["median at the end", "pressure NRMSE", "diverged", f"k = {AHEAD}, mm/s", "training, s"]
    rows = []
    for name, row in scores.items():
        strokes = [entry["mean"] for entry in row["stroke_error"]]
        tail = [row["stroke_error"][-1]["median"], row["pressure_nrmse"]["mean"], row["diverged"]]
        tail += [row["ahead"]["velocity_mae"]["mean"], row["training_s"]]
        rows.append([name, row["velocity_mae"]["mean"], *strokes, *tail])
    print(f"\n{first['runs']} runs of {first['seconds']:g} s")
    table(heads, rows)
    for name in (name for name, row in scores.items() if "intervals" in row):
        covered = scores[name]["intervals"]["at"]
        rows = [[f"{row['at_s']:g} s", *(f"{row[part]['share']:.1%}" for part in PARTS)] for row in covered]
        print(f"\ncoverage of the intervals of 90 %, {name}")
        table(["after", *PARTS], rows)


if __name__ == "__main__":
    main()
