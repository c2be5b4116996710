"""How good is a twin on public benchmarks in free run, beside what others published for them?

Each set is a machine with one actuator: a command, and a velocity (backward difference of the position or level) with
its integral. Where the league scores what does not integrate anything (the pressure of the arm), that stands in the
place of the velocity, alone: weights are chosen by the velocities of a twin. The twin is measured for a few ticks and
then runs on the commands through the whole test recording. Candidates are trained on the first four fifths of the
estimation data and chosen by a free run through the last fifth, with the first seed: recurrent networks of some
widths, and where the description of a set names its parts (two tanks, an axis with a drive) a twin of these elements.
The choice is trained with every seed, and so is the best candidate of the other formulation, which is shown beside it.
The median counts, and the spread is shown.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import Verdict, finish, parser, table
from edp.data.series import Series
from edp.data.twin_channels import TwinChannels, twin_channels
from edp.logs.source import DataSource
from edp.networks.twin import TWINS, Twin, fit_scales
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.lumped.parts import MassElement, TankElement
from edp.networks.twin.recurrent import Recurrent
from edp.recording import Recording
from edp.settings.tree import read_toml
from edp.signals import Channel, Kind
from edp.training.elements_fit import fit_elements
from edp.training.free_run import FreeRunSpec, fit_free_runs
from edp.training.optimizers import Soap
from published_leagues import verdicts_of
from real_recordings import EXAMPLES, VARIABLE, shared_folder

ESTIMATION = 0.8
"""Share of the estimation data that trains; the rest chooses."""
FLOORS = ("static", "arx")
Candidate = tuple[int, float] | ElementsBox
"""Units of a recurrent twin and weight of errors of its stroke, or elements."""


@dataclass(frozen=True)
class LeagueSet:
    """How a set becomes a machine with one actuator, and what is tried on it.

    Attributes:
        command: column of the command.
        stroke: column of the position or level; empty for none.
        velocity: column of the velocity; empty for the backward difference of the stroke.
        target: answer that the league scores.
        prefix_ticks: measured ticks before the free run.
        training: lengths and updates of the free runs.
        elements: what the description of the set says that it is made of; None where it names no parts.
        candidates: recurrent twins.
    """

    command: str
    stroke: str
    velocity: str
    target: str
    prefix_ticks: int
    training: FreeRunSpec
    elements: ElementsBox | None = None
    candidates: tuple[tuple[int, float], ...] = field(default=((8, 10.0), (16, 10.0), (32, 10.0), (16, 1.0)))


def spec_of(lengths_s: tuple[float, ...], validation_s: float) -> FreeRunSpec:
    """Free runs of these lengths; a recording of a thousand ticks needs few updates."""
    return FreeRunSpec(
        lengths_s=lengths_s, updates=(300, 300, 400), lanes=32, validate_every=50, validation_s=validation_s,
        optimizer=Soap(learning_rate=3e-3), patience=0,
    )  # fmt: skip


TWO_TANKS = ElementsBox(
    tanks=(TankElement(name="upper", source="command"), TankElement(name="lower", source="upper", level="stroke")),
    prefix_ticks=5, starts=2, rounds=25,
)  # fmt: skip
AXIS = ElementsBox(
    masses=(MassElement(name="axis", command="command", velocity="velocity"),),
    prefix_ticks=20, starts=2, rounds=15, length_s=2.0,
)  # fmt: skip
SETS = {
    "tanks.toml": LeagueSet("u", "y", "", "stroke", 5, spec_of((80.0, 240.0, 560.0), 600.0), TWO_TANKS),
    "emps.toml": LeagueSet("u", "q", "", "stroke", 20, spec_of((0.2, 1.0, 3.0), 4.0), AXIS),
    "sjoberg.toml": LeagueSet("u", "", "p", "velocity", 10, spec_of((10.0, 30.0, 60.0), 80.0)),
}


def machine(recording: Recording, which: LeagueSet) -> Recording:
    """The recording with the channels of one actuator."""
    columns, channels = [recording.column(which.command)], [Channel("command", Kind.RATIO)]
    channels.append(Channel("velocity", Kind.VELOCITY))
    if which.velocity:
        columns.append(recording.column(which.velocity))
    else:
        stroke = recording.column(which.stroke).astype(np.float64)
        columns += [np.diff(stroke, prepend=stroke[:1]) * recording.rate_hz, stroke]
        channels.append(Channel("stroke", Kind.POSITION))
    values = np.stack(columns, axis=1).astype(np.float32)
    return Recording(recording.name, tuple(channels), values, recording.rate_hz, recording.source)


def free_run_rmse(twin: Twin, part: Series, target: str) -> float:
    """Error of one free run through a whole stretch, behind the prefix."""
    prefix = twin.prefix_ticks
    column = [channel.name for channel in twin.channels.answers].index(target)
    state = twin.reset(part.inputs[None, :prefix], part.targets[None, :prefix])
    answers, _ = twin.rollout(part.inputs[None, prefix:-1], state)
    error: NDArray[np.float64] = answers[0, :, column].astype(np.float64) - part.targets[prefix + 1 :, column]
    return float(np.sqrt(np.square(error).mean()))


def trained(
    channels: TwinChannels, parts: tuple[Series, Series], which: LeagueSet, candidate: Candidate, seed: int
) -> Twin:
    """A twin of a candidate, with the weights or starting values that were best in the last fifth."""
    scales = fit_scales(channels, parts[:1])
    if isinstance(candidate, ElementsBox):
        return fit_elements(candidate.start(channels, scales, parts[:1], seed), parts[:1], parts[1:], seed).twin
    units, stroke_weight = candidate
    spec = Recurrent(units=units, prefix_ticks=which.prefix_ticks)
    twin = spec.start(channels, scales, parts[:1], seed)
    training = replace(which.training, seed=seed, stroke_weight=stroke_weight)
    return fit_free_runs(twin, parts[:1], parts[1:], training).twin


def named(candidate: Candidate) -> str:
    """How tables call it."""
    if isinstance(candidate, ElementsBox):
        return "elements"
    return f"recurrent, {candidate[0]} units, stroke weight {candidate[1]:g}"


def shortened(which: LeagueSet) -> LeagueSet:
    """One candidate of each formulation, hardly trained."""
    training = replace(which.training, updates=(20, 20, 20))
    elements = which.elements and replace(which.elements, starts=1, rounds=2)
    return replace(which, training=training, elements=elements, candidates=which.candidates[:1])


def measure(entry: dict[str, Any], which: LeagueSet, seeds: Sequence[int]) -> dict[str, Any]:
    """Test errors of the chosen candidate, a figure a seed, and of the floors, in the unit of the league."""
    began = time.process_time()
    estimation, test = (machine(recording, which) for recording in DataSource.of(EXAMPLES / entry["data"]).read())
    channels = twin_channels(estimation)
    task, cut = channels.task(), round(ESTIMATION * estimation.samples)
    parts = (task.series(estimation, 0, cut), task.series(estimation, cut))
    candidates: dict[str, list[Candidate]] = {"recurrent": list(which.candidates)}
    if which.elements is not None:
        candidates["elements"] = [which.elements]
    firsts = {one: trained(channels, parts, which, one, seeds[0]) for each in candidates.values() for one in each}
    errors = {one: free_run_rmse(twin, parts[1], which.target) for one, twin in firsts.items()}
    factor = 1000.0 if entry["unit"] == "mm" else 1.0
    judged = task.series(test)
    formulations: dict[str, Any] = {}
    for name, each in candidates.items():
        best = min(each, key=lambda one: errors[one])
        twins = {seeds[0]: firsts[best]}
        twins |= {seed: trained(channels, parts, which, best, seed) for seed in seeds[1:]}
        by_seed = {seed: factor * free_run_rmse(twin, judged, which.target) for seed, twin in twins.items()}
        shown = {"candidate": named(best), "validation": factor * errors[best], "ours": by_seed}
        formulations[name] = shown | {"median": statistics.median(by_seed.values())}
    chosen = min(formulations, key=lambda name: float(formulations[name]["validation"]))
    found: dict[str, Any] = {**formulations[chosen], "chosen": chosen, "formulations": formulations}
    scales = fit_scales(channels, [task.series(estimation)])
    for name in FLOORS:
        spec = replace(TWINS[name](), prefix_ticks=which.prefix_ticks)
        floor = spec.start(channels, scales, [task.series(estimation)], seeds[0])
        found[name] = factor * free_run_rmse(floor, judged, which.target)
    every = {named(one): factor * error for one, error in errors.items()}
    return found | {"every_validation": every, "processor_s": round(time.process_time() - began, 1)}


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    options = parser(__doc__ or "")
    options.add_argument("--shared", type=Path, default=None, help=f"folder of the recordings (else ${VARIABLE})")
    options.add_argument("--seeds", type=int, default=5)
    given = options.parse_args(arguments)
    if shared_folder(given.shared) is None:
        return
    verdicts: list[Verdict] = []
    kept: dict[str, Any] = {}
    for entry in read_toml(EXAMPLES / "leagues.toml")["leagues"]:
        seeds = range(given.seed, given.seed + (1 if given.quick else given.seeds))
        which = SETS[entry["data"]]
        found = measure(entry, shortened(which) if given.quick else which, seeds)
        print(f"\nFree run of a twin: {entry['title']}" + (" (quick: hardly trained)" if given.quick else ""))
        twins = [
            (f"{'TWIN' if n == found['chosen'] else 'twin'}, {n}", f["median"])
            for n, f in found["formulations"].items()
        ]
        rows = [*entry["published"].items(), *twins, *((f"{n}, here", found[n]) for n in FLOORS)]
        table(["method", "test RMSE"], sorted(rows, key=lambda pair: pair[1]))
        for name, one in found["formulations"].items():
            each = ", ".join(f"{value:.4g}" for value in one["ours"].values())
            print(f"{name} by seed: {each}; {one['candidate']}, {one['validation']:.4g} in the last fifth")
        print(f"chosen: {found['chosen']}; {found['processor_s']} processor s")
        verdicts += verdicts_of(entry, found, given.quick, ", twin")
        kept[entry["title"]] = found
    finish("twin_leagues", verdicts, given.seed, kept)


if __name__ == "__main__":
    main()
