"""How far off is a twin of a worn C14 in soil that knows 20 minutes of its logs, beside the static valve map?

Recordings of `c14_soil.toml`: a fifth of the time in gravel, a third in loam or sand, the rest in free air. Of 60
minutes 20 train and choose, the rest tests, by free runs of a minute on commands alone. What is asked: the default of
`edp twin`; a grey box that is told the linkage (beside bodies that are 10 to 50 % off), fitted to those of the 20
minutes that are in free air; the same with a ground that all of the 20 minutes taught; and with a network on top. The
one with less error on the validation part answers the goal. --work keeps what is finished, a file for each model, and
--only names some of them: the parts may run apart, and a last run over all gives the table.
"""

from __future__ import annotations

import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import tomli_w

from common import PrintedProgress, Verdict, finish, in_folder, kept, parser, table, verdict
from edp.config.twin import TwinExperiment, load_twin_experiment
from edp.data.prepared import Prepared
from edp.data.series import Series
from edp.data.splits import ByRecording
from edp.data.twin_channels import TwinChannels
from edp.evaluation.free_run import free_run_scores, free_runs
from edp.logs.source import DataSource
from edp.networks.twin import TWINS, Twin, fit_scales
from edp.networks.twin.base import TwinState
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.grey.ground import GroundedRunner, GroundLaw
from edp.networks.twin.greybox import GreyBox, GreyTwin
from edp.networks.twin.residual import Residual, ResidualTwin
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.training.free_run import FreeRunSpec
from edp.training.grey_fit import fit_grey_box
from edp.training.ground_fit import fit_ground
from edp.training.residual_fit import fit_residual
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin
from edp.workflows.twin import train_twin
from edp.workflows.twin.prepare_twin import prepare_twin
from twin import QUICK_FIT, WRONG, small, told

SCENARIO = Path(__file__).parents[1] / "examples" / "scenarios" / "c14_soil.toml"
MINUTES = 20.0
"""Of the logs that train and choose; a third of these chooses."""
MODELS = ("static", "default", "grey box", "grey box on a ground", "network on the grey box")
GROUNDS = ("dry_sand", "sandy_loam", "gravel")
"""Endings of the names of recordings in soil."""
VALIDATION_S = 10.0
FIT, STRETCHES = GreyFitSpec(ticks=2500, starts=1, final_rounds=0), 5
"""Of grey boxes: short ones, since it is soil that leaves errors, and not their numbers."""


@dataclass(frozen=True, eq=False)
class Logs:
    """Of the machine.

    Attributes:
        source: all recordings.
        experiment: how they are divided.
        channels: of a twin.
        data: stretches by part.
        work: folder of what is finished.
        quick: whether this is the short form.
        seed: of the recordings, divisions and fits.
    """

    source: DataSource
    experiment: TwinExperiment
    channels: TwinChannels
    data: Prepared
    work: Path
    quick: bool
    seed: int


class OnGround:
    """A grey box whose free runs stand on a ground that nothing has cut when they begin; the contract is a twin's.

    Args:
        twin: a grey box with a known linkage.
        law: of the ground.
    """

    def __init__(self, twin: GreyTwin, law: GroundLaw) -> None:
        self._twin, self._runner = twin, GroundedRunner(twin, law)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._twin, name)

    def rollout(self, commands: Any, state: TwinState) -> tuple[Any, TwinState]:
        """Answers ``(lane, tick, answer)`` to commands ``(lane, tick, command)``; the state is not brought on."""
        lanes = [self._lane(rows, {k: v[i : i + 1] for k, v in state.items()}) for i, rows in enumerate(commands)]
        return np.stack(lanes), state

    def _lane(self, commands: Any, state: TwinState) -> Any:
        free = np.full(len(self.channels.answers), np.nan, np.float32)
        self._runner.begin()
        self._runner.resistance = np.zeros_like(self._runner.resistance)
        answers = []
        for command in commands:
            state = self._runner.step(command, state, free)
            answers.append(state["answer"][0].copy())
        return np.array(answers, np.float32)


def main() -> None:
    arguments_of = parser(__doc__ or "")
    arguments_of.add_argument("--only", nargs="+", choices=MODELS, default=MODELS)
    arguments_of.add_argument("--minutes", type=float, default=5.0, help="of the default's networks; 0: no bound")
    arguments_of.add_argument("--candidates", nargs="+", default=(), help="of the default; else its own")
    arguments_of.add_argument("--workers", type=int, default=1, help="processes that train the default's networks")
    arguments_of.add_argument("--work", type=Path, default=None, help="folder that keeps what is finished")
    given = arguments_of.parse_args()
    in_folder(given.work, lambda work: run(given, work))


def run(given: Any, work: Path) -> None:
    """The models that were asked for; a result without static map and default is not kept."""
    logs = cache(lambda: recordings(given, work))  # none are simulated where all is finished
    makers: Mapping[str, Callable[[], tuple[Any, float]]] = {
        "static": lambda: static_map(logs()),
        "default": lambda: default_twin(logs(), given),
        "grey box": lambda: grey_box(logs()),
        "grey box on a ground": lambda: grounded(logs()),
        "network on the grey box": lambda: topped(logs()),
    }
    scores = {}
    for name in (name for name in MODELS if name in given.only):
        file = work / f"{name.replace(' ', '_')}{'_quick' if given.quick else ''}.json"
        scores[name] = kept(file, lambda name=name: scored(logs(), makers[name]))
    show(scores)
    judged = {"static", "default"} <= set(scores)
    finish("twin_soil", verdicts(scores, given.quick) if judged else [], given.seed, scores, keep=judged)


def recordings(given: Any, work: Path) -> Logs:
    """Of the machine, simulated where there are none yet, divided by whole recordings."""
    quick: dict[str, Any] = {"minutes": 10.0, "recordings": 10} if given.quick else {}
    # Strokes and pump pressures are those of the simulation, as in `twin.py`: a linkage needs them.
    order = replace(SimulationOrder.of(SCENARIO, seed=given.seed, **quick), suffix=".parquet", layout="", truth="with")
    folder = given.data or work / f"c14{'_quick' if quick else ''}"
    simulate_data_set(folder, order, workers=given.workers)
    source = DataSource.of(folder)
    names = [recording.name for recording in source.read()]
    count = 5 if quick else round(MINUTES / order.minutes * order.recordings)
    drawn = [names[i] for i in np.random.default_rng(given.seed).permutation(len(names))]
    split = ByRecording(validation=tuple(drawn[: count // 3]), test=tuple(drawn[count:]))
    experiment = replace(load_twin_experiment(None, ("twin.kind=recurrent",)), split=split)
    channels, data = prepare_twin(source, experiment)
    return Logs(source, experiment, channels, data, work, bool(quick), given.seed)


def scored(logs: Logs, made: Callable[[], tuple[Any, float]]) -> dict[str, Any]:
    """Errors of free runs of a minute in the test part: of all, of those in soil and of those in free air."""
    twin, seconds = made()
    began, judge = time.process_time(), logs.experiment.judge
    runs = free_runs(twin, logs.data.test, 60.0, 1 if logs.quick else 2)
    soil = np.array([name.endswith(GROUNDS) for name in runs.names])
    parts = {"all": np.full(len(soil), True), "soil": soil, "air": ~soil}
    rows = {name: free_run_scores(runs.only(np.flatnonzero(of)), judge) for name, of in parts.items() if of.any()}
    chooses = free_run_scores(free_runs(twin, logs.data.validation, VALIDATION_S, 2 if logs.quick else 6), judge)
    facts = {"training_s": seconds, "judging_s": time.process_time() - began}
    return {"parts": rows, "validation_mae": chooses["velocity_mae"]["mean"]} | facts


def in_soil(series: Sequence[Series]) -> list[Series]:
    """Those that work the ground."""
    return [one for one in series if one.name.endswith(GROUNDS)]


def in_air(series: Sequence[Series]) -> list[Series]:
    """All others."""
    return [one for one in series if not one.name.endswith(GROUNDS)]


def static_map(logs: Logs) -> tuple[Twin, float]:
    """The floor; it needs no choice, so the validation part teaches it as well."""
    began, everything = time.process_time(), [*logs.data.train, *logs.data.validation]
    twin = TWINS["static"]().start(logs.channels, fit_scales(logs.channels, logs.data.train), everything, logs.seed)
    return twin, time.process_time() - began


def default_twin(logs: Logs, given: Any) -> tuple[Twin, float]:
    """What `edp twin --minutes M` chooses."""
    changes = [f"twin.minutes={0.1 if logs.quick else given.minutes}", "judge.floors=[]", "judge.starts=1"]
    changes += ["judge.calibration_starts=2", *(f"twin.candidates={list(some)}" for some in [given.candidates] if some)]
    experiment = replace(load_twin_experiment(None, changes), split=logs.experiment.split)
    out = logs.work / f"run_default{'_quick' if logs.quick else ''}"
    trained = train_twin(logs.source, experiment, out, progress=PrintedProgress(), workers=given.workers)
    print("chosen:", trained.bundle.provenance.get("chosen"), flush=True)
    return trained.bundle.twin, float(trained.bundle.provenance["seconds"])


def grey_box(logs: Logs) -> tuple[GreyTwin, float]:
    """Told the linkage, fitted to what is in free air; from the folder where an earlier part fitted it."""
    home = logs.work / f"grey{'_quick' if logs.quick else ''}"
    if home.exists():
        bundle = load_twin(home)
        twin: Any = bundle.twin
        return twin, float(bundle.provenance["seconds"])
    form = GreyBox(fit=QUICK_FIT if logs.quick else FIT, stretches=STRETCHES, linkage=str(guess(logs.work)))
    train, validation = in_air(logs.data.train), in_air(logs.data.validation)
    start = form.start(logs.channels, fit_scales(logs.channels, logs.data.train), train, logs.seed)
    fitted = fit_grey_box(start, train, validation, logs.seed, told)
    save_twin(TwinBundle(fitted.twin.spec, fitted.twin, {"seconds": fitted.seconds}), home)
    return fitted.twin, fitted.seconds


def guess(work: Path) -> Path:
    """Machine file with C14's linkage and bodies that are not its own."""
    file = work / "guess.toml"
    if file.exists():
        return file
    found = tomllib.loads((resources.files("edp.sim") / "machines" / "c14.toml").read_text(encoding="utf-8"))
    for key, factors in WRONG.items():
        found["bodies"][key] = [value * factor for value, factor in zip(found["bodies"][key], factors, strict=True)]
    file.write_text(tomli_w.dumps(found), encoding="utf-8")
    return file


def grounded(logs: Logs) -> tuple[OnGround, float]:
    """The grey box on a ground that the recordings in soil taught."""
    twin, seconds = grey_box(logs)
    train, validation = in_soil(logs.data.train), in_soil(logs.data.validation)
    fitted = fit_ground("drag", twin, train, validation, str(guess(logs.work)))
    print("explained of the forces in the ground:", fitted.explained, flush=True)
    return OnGround(twin, fitted.law), seconds + fitted.seconds


def topped(logs: Logs) -> tuple[Twin, float]:
    """A network on the grey box, taught by all recordings."""
    twin, seconds = grey_box(logs)
    form = Residual(fit=QUICK_FIT, linkage=str(guess(logs.work)))
    form = small(form) if logs.quick else form
    network = form.start(logs.channels, twin.scales, in_air(logs.data.train)[:1], logs.seed)
    if not isinstance(network, ResidualTwin):
        raise TypeError("a residual form starts a residual twin")
    whole = ResidualTwin(twin, network.network)
    fit = fit_residual(whole, form, logs.data.train, logs.data.validation, FreeRunSpec(seed=logs.seed), told)
    print(f"network helps: {fit.helps}, validation {fit.error:.4f} against {fit.grey_error:.4f}", flush=True)
    return fit.twin, seconds + fit.seconds


def verdicts(scores: Mapping[str, Any], quick: bool) -> list[Verdict]:
    """What is asked of the model that has less error on the validation part."""
    best = min((name for name in scores if name != "static"), key=lambda name: scores[name]["validation_mae"])
    result = []
    for part in scores[best]["parts"]:
        ours, rival = (scores[name]["parts"][part]["stroke_error"][-1]["mean"] for name in (best, "static"))
        name = f"C14 in soil after 20 minutes, {best}, {part}: stroke error at 60 s against the static map"
        result.append(verdict(name, ours, rival, "<= 0.25", "mm", quick))
    return result


def show(scores: Mapping[str, Any]) -> None:
    """Print a row a model and part."""
    rows = []
    for name, score in scores.items():
        for part, row in score["parts"].items():
            strokes = " / ".join(f"{entry['mean']:.3g}" for entry in row["stroke_error"])
            cells = [row["runs"], row["velocity_mae"]["mean"], strokes, row["stroke_error"][-1]["median"]]
            cells += [row["pressure_nrmse"]["mean"], row["diverged"], score["validation_mae"], score["training_s"]]
            rows.append([f"{name}, {part}", *cells])
    heads = ["model", "runs", "velocity MAE, mm/s", "strokes by time, mm", "median at the end", "pressure NRMSE"]
    table([*heads, "diverged", "validation, mm/s", "training, s"], rows)


if __name__ == "__main__":
    main()
