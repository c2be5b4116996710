"""Machine file of the simulator from logs: a grey box is fitted, and its values are written back."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.config.twin import TWIN_SETTINGS, TwinExperiment, load_twin_experiment, twin_toml
from edp.data.oil import FREEZING_K, OIL
from edp.data.prepared import Prepared
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError, StorageError
from edp.evaluation.free_run import check_runs, free_run_scores, free_runs
from edp.evaluation.free_run_file import FreeRunScores
from edp.evaluation.guard import GREY, MACHINE
from edp.logs.source import DataSource
from edp.networks.twin import TWINS, TwinSpec, even_starts, fit_scales
from edp.networks.twin.grey.datasheet import BASIS
from edp.networks.twin.greybox import POLYNOMIALS, GreyBox, GreyTwin
from edp.networks.twin.model_selection import KINDS, AutoTwin
from edp.networks.twin.parameters import UNEXCITED, posterior_deviations
from edp.networks.twin.residual import Residual
from edp.networks.twin.windows import MeasuredWindows
from edp.progress import SILENT, Progress
from edp.recording import Recording
from edp.settings.results import plain_value
from edp.signals import Kind
from edp.sim.machine.machine import Machine
from edp.sim.machine.machine_files import load_machine, parse_machine
from edp.storage import check_writable, read_object, write_bytes, write_json
from edp.storage.arrays import numbers_in
from edp.storage.headers import model_digest
from edp.storage.paths import is_there
from edp.storage.provenance import PROVENANCE
from edp.storage.runs import Run, check_claimable, run_key
from edp.training.grey_fit import GreyProblem, fit_grey_box
from edp.training.identification.bodies import Poses, read_bodies, realise_bodies
from edp.training.identification.elements import (
    NO_MOTORS,
    check_same_linkage,
    check_strokes,
    excavator_elements,
    full_commands,
    parts_of,
)
from edp.training.identification.machine_numbers import MACHINE_NUMBERS
from edp.training.identification.machine_text import machine_text
from edp.training.identification.mapping import GreyParts
from edp.training.identification.parametrisation import MachineParametrisation, nearest_machine, reset_to_guess
from edp.training.identification.rows import TOLD, IdentifiedNumber, body_rows, line_comments, number_rows
from edp.training.identification.stability import covariance
from edp.training.progress_steps import free_run_steps
from edp.training.provenance import training_provenance
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin
from edp.wording import percent, typed
from edp.workflows.identify.compare import FrontChannels, simulate_machine
from edp.workflows.twin.prepare_twin import cut_recordings

Doubles = NDArray[np.float64]
KIND, RUN, RESULT, GREY_FOLDER = "identification", ".run", "identification.json", "grey"
GREY_STAGE = "grey_box"
LAST_STAGES = 2
"""Of the fit's stages, those that refine the machine itself: its free runs are long from the beginning."""
ROUNDS_THAT_INFORM = 3
"""Rounds from which the information of a grey box is taken that was fitted before."""


@dataclass(frozen=True, eq=False)
class Identified:
    """Result of `identify`.

    Attributes:
        machine: identified, as its file has it.
        rows: row of each parameter.
        scores: scores of the identified machine, the guess, the grey box and the static map on held-out recordings.
        notes: remarks for the reader.
    """

    machine: Machine
    rows: list[IdentifiedNumber]
    scores: Mapping[str, FreeRunScores]
    notes: list[str]


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Grey box of an excavator front, with the information on its values."""

    twin: GreyTwin
    information: Doubles


@dataclass(frozen=True, eq=False)
class _FittedMachine:
    """Machine fitted through its grey box, with the final coordinates and the state of the last rounds."""

    twin: GreyTwin
    coordinates: MachineParametrisation
    theta: Doubles
    information: Doubles


def identify(
    source: DataSource,
    out: str | Path,
    machine: str = "M22",
    experiment: TwinExperiment | None = None,
    run: str | Path | None = None,
    progress: Progress = SILENT,
) -> Identified:
    """Find simulator parameters that reproduce the logs, and write the machine file.

    Next to it a file of the same name that ends in ``.json`` has every number and the scores, and a run folder that
    ends in ``.run`` the stages of the fit: the same call continues after a stop.

    Args:
        source: the logs.
        out: machine file (.toml) to write.
        machine: name or file of the guess; its pins, lengths and bores hold, and what the logs do not tell.
        experiment: settings of a grey box, its fit and the division of the logs; by default `GreyBox`'s.
        run: run folder of a grey box of these logs, in place of a fit.
        progress: receiver of what begins; the units of a fit are rounds.

    Raises:
        EdpError: logs, guess, settings or run that do not fit each other, or an identified machine that cannot be;
            no machine file is written then.
    """
    target, began = _new_file(out), time.process_time()
    check_claimable(target.with_suffix(RUN), KIND)
    if run is not None and experiment is not None:
        raise ConfigError(
            f"--run {run} comes with settings; a run keeps its own: leave --config and --set out, or --run to fit anew"
        )
    base = load_machine(machine)
    progress.note("reading logs")
    recordings = source.read()
    loaded = None if run is None else _read_run(run)
    settings = experiment or load_twin_experiment(None, ["twin.kind=greybox"])
    settings = loaded[1] if loaded is not None else settings
    grey = _whole_grey_box(settings.twin)
    if grey.linkage and loaded is None:
        raise ConfigError(
            f"settings: twin.linkage = '{grey.linkage[:80]}' came; the linkage is that of --machine ({base.name}): "
            "leave twin.linkage out"
        )
    channels, data = cut_recordings(recordings, settings)
    _check_strokes(channels, data, base)
    # What could not be judged, or holds no number, is refused before the fit of minutes.
    celsius, notes = _celsius(recordings, base)
    scales, judge = fit_scales(channels, data.train) if loaded is None else loaded[0].scales, settings.evaluation
    check_runs(channels, scales, grey.prefix_ticks, data.test, judge.duration_s, judge.starts)
    if loaded is not None:
        check_same_linkage(loaded[0], base, machine)
    made_of = {"machine": asdict(base), "from": None if run is None else model_digest(run)}
    key = run_key({"identify": TWIN_SETTINGS.to_dict(settings)} | made_of, data.digest)
    with Run.create(target.with_suffix(RUN), KIND, key, twin_toml(settings)) as opened:
        if loaded is None:
            fitted = _fit_grey_box(opened, base, machine, grey, (channels, data, settings.training.seed), progress)
        else:
            fitted = _add_information(loaded[0], data, settings.training.seed)
        parts = parts_of(fitted.twin, base, celsius)
        notes += _notes(parts)
        progress.note("fitting the machine itself to free runs")
        fit = _refine_machine(opened, base, parts, fitted, (data, settings), progress)
        progress.note("asking what parts of the logs, and runs of other lengths, would say")
        spread = _stage(
            opened,
            "covariance",
            {"covariance": (len(fit.theta), len(fit.theta))},
            lambda: {
                "covariance": covariance(fit.twin, fit.coordinates, fit.theta, data.train, settings.training.seed)
            },
        )["covariance"]
        machine_found, rows, doubts = _machine(fit, spread, data)
        notes += doubts
        machine_found = replace(machine_found, name=_name(target), description=_description(base))
        text = machine_text(machine_found, _head(base, rows, notes), line_comments(rows))
        try:
            # As a reader of the file will check it: what cannot be simulated is not written.
            written = parse_machine(text, target.name)
        except ConfigError as error:
            raise ConfigError(
                f"the identified machine cannot be ({error}); the logs do not fit machine {base.name}: check units, "
                "map, and pins and bores of --machine"
            ) from error
        progress.note("driving both machines by the commands of held-out recordings")
        scores = _scores(fitted, (base, written), parts, (data, settings))
        write_bytes(target, text.encode())
        facts = {"schema": 1, "machine": str(target), "base": base.name, "basis": BASIS, "notes": notes}
        write_json(
            target.with_suffix(".json"),
            facts | {"numbers": [row.to_dict() for row in rows], "models": plain_value(scores)},
        )
        seconds = time.process_time() - began
        provenance = training_provenance(source, data, settings.training.seed, 1, seconds)
        write_json(opened.file(PROVENANCE), provenance.to_table())
        write_json(opened.file(RESULT), {"schema": 1, "machine": str(target)})
    return Identified(written, rows, scores, notes)


def _stage(
    run: Run, name: str, shapes: Mapping[str, tuple[int, ...]], compute: Callable[[], Mapping[str, Doubles]]
) -> dict[str, Doubles]:
    """Return the arrays of a stage of the fit; compute them at the first call for a run.

    Raises:
        StorageError: the file of the stage is damaged.
    """
    if not is_there(_stage_file(run, name)):
        _write_stage(run, name, compute())
    # Read back after the first computation, too, so that a continued run has the same bits.
    return _read_stage(run, name, shapes)


def _stage_file(run: Run, name: str) -> Path:
    return run.file(f"{name}.json")


def _write_stage(run: Run, name: str, arrays: Mapping[str, Doubles]) -> None:
    write_json(_stage_file(run, name), {key: np.asarray(values).tolist() for key, values in arrays.items()})


def _read_stage(run: Run, name: str, shapes: Mapping[str, tuple[int, ...]]) -> dict[str, Doubles]:
    file = _stage_file(run, name)
    content = read_object(file, shapes)
    return {key: numbers_in(content[key], f"'{file}', {key},", shape) for key, shape in shapes.items()}


def _new_file(out: str | Path) -> Path:
    """Check the path of the machine file before a fit of minutes: it must not exist, nor the file next to it.

    Raises:
        ConfigError: another ending.
        StorageError: one of the two files is there, or the folder cannot be written.
    """
    target = Path(out)
    if target.suffix.lower() != ".toml":
        raise ConfigError(f"--out {out}: a machine file ends in .toml; edp simulate reads it")
    for file in (target, target.with_suffix(".json")):
        # It may be what a tape measure told, and the very file of --machine.
        if is_there(file):
            raise StorageError(f"--out {out}: '{file}' is there already and is not written over; choose another name")
    check_writable(target.parent)
    return target


def _whole_grey_box(spec: TwinSpec | AutoTwin) -> GreyBox:
    """Return the spec, after a check that it is a grey box.

    Raises:
        ConfigError: another kind, a network on top, which takes part of what the numbers are to explain, or parts that
            are left out.
    """
    if not isinstance(spec, GreyBox) or isinstance(spec, Residual):
        raise ConfigError(
            f"settings: a machine is identified by a grey box, twin.kind = '{KINDS.name_of(spec)}' came; leave it out, "
            "or set twin.kind = 'greybox'"
        )
    if spec.motors:
        raise ConfigError(NO_MOTORS)
    if spec.omit:
        raise ConfigError(
            f"settings: twin.omit = {list(spec.omit)} leaves out numbers that a machine file has; identify with "
            "a grey box that has all of them"
        )
    return spec


def _read_run(run: str | Path) -> tuple[GreyTwin, TwinExperiment]:
    bundle = load_twin(run)
    if not isinstance(bundle.twin, GreyTwin):
        raise ConfigError(
            f"--run {run}: it holds a twin of kind '{TWINS.name_of(bundle.spec)}'; numbers of a machine are those of a "
            "grey box: give a run of twin.kind = 'greybox', or leave --run out to have one fitted"
        )
    # A run that chose among formulations keeps the one that it chose in its bundle.
    return bundle.twin, replace(load_twin_experiment(Path(run) / "config.toml"), twin=bundle.spec)


def _fit_grey_box(
    run: Run, base: Machine, machine: str, spec: GreyBox, logs: tuple[TwinChannels, Prepared, int], progress: Progress
) -> _Fitted:
    """Return a grey box with the elements of an excavator front, fitted to the logs; `logs` ends with the seed.

    `machine` is the name or file of `base`.
    """
    channels, data, seed = logs
    elements = excavator_elements(channels, base)
    full = np.array(full_commands(channels, elements, base), np.float32)
    spec = replace(spec, cylinders=elements.cylinders, valves=elements.valves, pumps=elements.pumps)
    # Its own pins and lengths hold; polynomials of the strokes where a degree of them is asked for.
    spec = replace(spec, linkage=machine) if spec.degrees == POLYNOMIALS else spec
    begun = spec.start(channels, fit_scales(channels, data.train), data.train, seed)
    twin = GreyTwin(channels, begun.scales, spec, (begun.table, begun.wiring), begun.numbers, full)

    if not is_there(_stage_file(run, GREY_STAGE)):
        progress.note("fitting a grey box to free runs")
        fitted = fit_grey_box(twin, data.train, data.validation, seed, free_run_steps(progress))
        save_twin(TwinBundle(fitted.twin.spec, fitted.twin), run.file(GREY_FOLDER))
        _write_stage(run, GREY_STAGE, {"information": fitted.information})
    grey = load_twin(run.file(GREY_FOLDER)).twin
    if not isinstance(grey, GreyTwin):
        raise StorageError(f"'{run.file(GREY_FOLDER)}' holds no grey box; remove '{run.path}' and start again")
    count = len(grey.numbers)
    return _Fitted(grey, _read_stage(run, GREY_STAGE, {"information": (count, count)})["information"])


def _add_information(twin: GreyTwin, data: Prepared, seed: int) -> _Fitted:
    """Return an earlier grey box with the information of free runs of its last stage."""
    problem, spec = GreyProblem(twin, data.train), twin.spec.fit
    rng, total = np.random.default_rng(seed), np.zeros((len(twin.numbers),) * 2)
    ticks = max(1, round(spec.lengths_s[-1] * twin.channels.rate_hz))
    for _ in range(ROUNDS_THAT_INFORM):
        drawn = problem.draw(ticks, max(8, min(spec.batch, spec.ticks // ticks)), rng)
        total += problem.normal_equations(np.zeros(len(twin.numbers)), drawn, True).matrix
    return _Fitted(twin, total / ROUNDS_THAT_INFORM)


def _refine_machine(
    run: Run,
    base: Machine,
    parts: GreyParts,
    fitted: _Fitted,
    logs: tuple[Prepared, TwinExperiment],
    progress: Progress,
) -> _FittedMachine:
    """Return the machine fitted to free runs through its grey box."""
    data, settings = logs
    guess = MachineParametrisation.from_guess(base, parts, fitted.twin.numbers[parts.load])
    own = replace(guess, begin=nearest_machine(guess, fitted.twin.numbers, fitted.information))
    twin, fit = fitted.twin, fitted.twin.spec.fit
    last = replace(fit, lengths_s=fit.lengths_s[-LAST_STAGES:], rounds=fit.rounds[-LAST_STAGES:], starts=1)
    spec = replace(twin.spec, fit=last)
    tied = GreyTwin(twin.channels, twin.scales, spec, (twin.table, twin.wiring), own.values(own.begin), twin.full)

    def refine() -> dict[str, Doubles]:
        result = fit_grey_box(
            tied, data.train, data.validation, settings.training.seed + 1, free_run_steps(progress), own
        )
        return {"theta": result.theta, "information": result.information}

    count = len(own.begin)
    stage = _stage(run, "machine", {"theta": (count,), "information": (count, count)}, refine)
    return _FittedMachine(twin.with_parameters(own.values(stage["theta"])), own, stage["theta"], stage["information"])


def _machine(fit: _FittedMachine, spread: Doubles, data: Prepared) -> tuple[Machine, list[IdentifiedNumber], list[str]]:
    """Return the machine of the coordinates, with undetermined ones reset to the guess; one row per number, and notes.

    Where no rigid bodies have the fitted load, as after short logs, the guess's bodies stay: valves and pumps are worth
    having without them.
    """
    twin, own, theta, information = fit.twin, fit.coordinates, fit.theta, fit.information
    count, left = len(MACHINE_NUMBERS), np.sqrt(np.diag(spread))
    # What the fit had no information of; a number that is told badly stays where the others made up for it.
    excited = posterior_deviations(information)[:count] < UNEXCITED
    back = np.concatenate([~excited, np.zeros(len(theta) - count, np.bool_)])
    final = replace(own, free=excited)
    settled = reset_to_guess(theta, information, back)
    machine, load = final.machine(settled), own.load_at(settled)
    valves = machine.valves
    missing = np.array(own.parts.conflux) < 0
    shares: dict[str, Any] = {
        key: tuple(0.0 if none else float(v) for v, none in zip(getattr(valves, key), missing, strict=True))
        for key in ("conflux_extend", "conflux_retract")
    }
    machine = replace(machine, valves=replace(valves, **shares))
    machine = replace(machine, oil=replace(machine.oil, temperature=own.parts.celsius))
    speeds = len(twin.channels.velocities)
    strokes = np.concatenate([part.targets[:, speeds : 2 * speeds] for part in data.train]).astype(np.float64)
    poses = Poses.from_strokes(machine, strokes)
    nine, body = body_rows(own, load, spread[count:, count:], twin.wiring.z_of, poses)
    numbers = number_rows(own.base, machine, left[:count], excited)
    if own.parts.table.front is not None:
        return replace(machine, bodies=read_bodies(load, own.base)), numbers + body, []
    try:
        return replace(machine, bodies=realise_bodies(nine, own.base)), numbers + body, []
    except ConfigError as error:
        guessed_rows = [
            replace(row, value=row.base, low=row.base, high=row.base, excited=False, is_told=False) for row in body
        ]
        return machine, numbers + guessed_rows, [f"bodies are those of machine {own.base.name}: {error}"]


def _check_strokes(channels: TwinChannels, data: Prepared, base: Machine) -> None:
    count = len(channels.velocities)
    excavator_elements(channels, base)  # raises if a channel is missing
    rows = [part.targets[:, count : 2 * count] for part in (*data.train, *data.validation, *data.test)]
    low, high = (getattr(np.concatenate(rows), end)(axis=0) for end in ("min", "max"))
    if len(channels.strokes) == 3:
        check_strokes(channels.strokes, low, high, base)


def _celsius(recordings: Sequence[Recording], base: Machine) -> tuple[float, list[str]]:
    """Return the oil temperature of the logs, and a note on it."""
    logged = [
        r.column(OIL)
        for r in recordings
        if OIL in r.channel_names and r.channels[r.index(OIL)].kind is Kind.TEMPERATURE
    ]
    if len(logged) < len(recordings):
        celsius = base.oil.temperature
        return celsius, [f"the logs have no {OIL}: {typed(celsius)} degC of machine {base.name} is taken"]
    celsius = float(np.nanmean(np.concatenate(logged).astype(np.float64))) - FREEZING_K
    if not np.isfinite(celsius):
        raise DataError(f"'{OIL}' holds no number; correct the log, or leave the channel out")
    return celsius, [f"leakage, viscous friction and bulk modulus are those at the logs' mean of {celsius:.1f} degC"]


def _notes(parts: GreyParts) -> list[str]:
    notes = []
    if min(parts.conflux) < 0:
        notes.append("commands of second spools are not logged: conflux_extend and conflux_retract are 0 there")
    far = [share for share in parts.reach if share < 0.9]
    if far:
        notes.append(f"commands reach {percent(min(far))} of the full pilot only; curves beyond are extrapolated")
    notes.append("masses are not told apart from where they sit: inertia and gravity of the joints are")
    notes.append("pump flow and power are told times the volumetric efficiency, which is the guess's")
    return notes


def _scores(
    fitted: _Fitted, machines: tuple[Machine, Machine], parts: GreyParts, logs: tuple[Prepared, TwinExperiment]
) -> dict[str, FreeRunScores]:
    """Return the free runs along held-out recordings.

    The identified machine, the guess, the grey box and the static map.
    """
    data, settings = logs
    twin, judge = fitted.twin, settings.evaluation
    prefix, grey = twin.prefix_ticks, free_runs(twin, data.test, judge.duration_s, judge.starts)
    ticks = prefix + grey.truth.shape[1]
    windows = MeasuredWindows.read(even_starts(twin, data.test, ticks + 1, judge.starts), ticks)
    front = FrontChannels.from_twin(twin, parts, machines[0])
    floor: TwinSpec = replace(TWINS["static"](), prefix_ticks=twin.prefix_ticks)
    static = floor.start(twin.channels, twin.scales, data.train, settings.training.seed)
    runs = {
        MACHINE: replace(grey, answers=simulate_machine(machines[1], front, windows, prefix)),
        f"machine {machines[0].name}": replace(grey, answers=simulate_machine(machines[0], front, windows, prefix)),
        GREY: grey,
        "static map": free_runs(static, data.test, judge.duration_s, judge.starts),
    }
    return {name: free_run_scores(each, judge) for name, each in runs.items()}


def _name(out: Path) -> str:
    """Return a valid machine name from the name of the file."""
    name = "".join(c if c.isascii() and (c.isalnum() or c in "_-") else "-" for c in out.stem).strip("-_")
    return name or "identified"


def _description(base: Machine) -> str:
    return f"identified from logs; geometry and what they do not tell are those of {base.name}"


def _head(base: Machine, rows: Sequence[IdentifiedNumber], notes: Sequence[str]) -> list[str]:
    told_count, rough_count = sum(row.is_told for row in rows), sum(row.excited and not row.is_told for row in rows)
    return [
        f"Identified from logs by edp calibrate: {told_count} of {len(rows)} numbers are told, {rough_count} roughly.",
        "Behind a number: an approximate 95 % interval, from how far parts of the logs and runs of other lengths",
        f"differ ('roughly' where it is wider than {percent(TOLD)}), or that the number is kept. Numbers without a",
        f"comment are those of machine {base.name}, bodies but for their lengths excepted.",
        *notes,
    ]
