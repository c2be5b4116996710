"""``edp export RUN --format controller``: a controller that was run, as C99 without heap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.controllers.nmpc import STEP_M_S, NmpcController, PredictiveControl
from edp.control.controllers.pi import MAX_SUM, PiController, ProportionalIntegral
from edp.control.geometry import AXES
from edp.control.limits import LoopLimits
from edp.control.models import ControlModels
from edp.control.nmpc.moves import SpeedToLever
from edp.control.nmpc.tip import TipTable
from edp.control.plant import PILOTS, STROKES, VELOCITIES, PlantInterface
from edp.control.reference import TipReference
from edp.control.valve_map import SIDES, ValveMap
from edp.errors import ConfigError, ExportError
from edp.export.controller import ControllerParts, GoldenLoop, PilotCommand, PlanParts, write_controller
from edp.networks.input_range import input_limits
from edp.sim.machine import layout as at
from edp.sim.machine.machine import Machine
from edp.sim.machine.parameters import pack
from edp.training.twin_bundle import TwinBundle, plant_bundle
from edp.workflows.control.kept import KeptController, load_kept

MOST: Mapping[str, int] = {"iterations": 100, "newton": 1_000}
"""Iterations a tick: of the solver, of which 5 to 20 were seen in loops; of a grey box's equations."""
MAX_ITERATIONS = 100_000
FARTHEST_M = 100.0
"""Stroke above which the measurement counts as missing; cylinders are shorter."""
Array = NDArray[np.float64]


def export_controller(
    run: str | Path, folder: str | Path, name: str, options: Mapping[str, str] | None = None
) -> list[Path]:
    """Write the controller of a run of edp loop run as C99.

    Args:
        run: its run folder.
        folder: output folder.
        name: prefix of its C functions and files.
        options: ``iterations``, the solver's most a tick; ``newton``, those of a grey box's equations.

    Returns:
        The files, the one to read first in front.

    Raises:
        EdpError: not such a run, a controller or twin without a form in C, a name or an option that cannot be.
    """
    most = _most(options or {})
    stored = load_kept(run)
    parts = parts_of(stored.experiment, stored.plant, stored.models, stored.twin, most)
    return write_controller(replace(parts, golden=golden_loop(parts, stored)), name, Path(folder))


def parts_of(
    experiment: ControlExperiment,
    plant: PlantInterface,
    models: ControlModels,
    twin: TwinBundle | None,
    most: Mapping[str, int] = MOST,
) -> ControllerParts:
    """Return the exported parts of a controller, without a self-test.

    Args:
        experiment: its settings.
        plant: interface of the plant.
        models: valve map, and the twin of a plan.
        twin: the same twin together with its settings.
        most: iterations a tick, of the solver and of a grey box's equations.

    Raises:
        ExportError: a controller without a form in C.
        ConfigError: a model is missing.
    """
    spec, limits = experiment.controller, experiment.task.limits
    if not isinstance(spec, ProportionalIntegral | PredictiveControl):
        raise ExportError(
            f"controller '{CONTROLLERS.name_of(spec)}' has no form in C; these have: pi, nmpc. Run edp loop run with "
            "one of them"
        )
    valves = models.require_map(CONTROLLERS.name_of(spec))
    loop = spec if isinstance(spec, ProportionalIntegral) else ProportionalIntegral()
    plan: PlanParts | None = None
    reads: tuple[str, ...] = STROKES
    low, high = np.full(AXES, -FARTHEST_M), np.full(AXES, FARTHEST_M)
    if isinstance(spec, PredictiveControl):
        if twin is None:
            raise ConfigError("controller 'nmpc' needs a twin; the run has none")
        # The controller's own checks of twin and plant, and the channels that it reads.
        controller = spec.build(plant, limits, models)
        reads = controller.reads
        plan = _plan(spec, plant, limits, valves, twin, (reads, most))
        ends = input_limits(plan.plant.predictor)
        commands = len(twin.twin.channels.commands)
        low, high = (np.asarray(values)[[commands + port for port in plan.ports]] for values in ends)
    channels = {channel.name: channel for channel in plant.channels}
    table = TipTable(plant.geometry)
    return ControllerParts(
        title=f"controller '{CONTROLLERS.name_of(spec)}' of a run of edp loop run",
        machine=plant.geometry.machine.name,
        inputs=tuple(channels[name] for name in reads),
        limits_low=low,
        limits_high=high,
        stroke_inputs=tuple(reads.index(name) for name in STROKES),
        rate_hz=plant.rate_hz,
        angles=table.angles,
        full_m=plant.geometry.full_m,
        lengths_m=np.array(plant.geometry.machine.bodies.length, float),
        lever_low=np.array(limits.lever_low),
        lever_high=np.array(limits.lever_high),
        slew=np.array(limits.slew_per_s) / plant.rate_hz,
        sides=[_sides(valves, axis) for axis in range(AXES)],
        gains=(loop.proportional, loop.integral, loop.standstill_m_s, MAX_SUM),
        lead=round(loop.lead_s * plant.rate_hz),
        plan=plan,
        golden=None,
    )


def _plan(
    spec: PredictiveControl,
    plant: PlantInterface,
    limits: LoopLimits,
    valves: ValveMap,
    twin: TwinBundle,
    reads: tuple[tuple[str, ...], Mapping[str, int]],
) -> PlanParts:
    names, most = reads
    channels = twin.twin.channels
    answers = [channel.name for channel in channels.answers]
    inverse, attitude_m = SpeedToLever(valves, limits), spec.attitude_with(twin.twin)
    plan = PlanParts(
        plant=plant_bundle(twin),
        blocks=spec.blocks,
        pilots=_pilots(plant.geometry.machine, tuple(channel.name for channel in channels.commands)),
        lever_shape=_lever_shape(plant.geometry.machine),
        ports=tuple(answers.index(name) for name in names),
        strokes=tuple(answers.index(name) for name in STROKES),
        velocities=tuple(answers.index(name) for name in VELOCITIES),
        pressures=tuple(n for n, name in enumerate(answers) if name.startswith("CylPressures_")),
        sides=[(sides[0], sides[1]) for sides in inverse.tables],
        slowest=inverse.slowest,
        fastest=inverse.fastest,
        step_m_s=STEP_M_S,
        window=max(1, round(spec.window_s * plant.rate_hz)),
        weights=(spec.along, attitude_m, spec.change, spec.feedforward, spec.trust_m_s, spec.smoothing),
        margin=limits.stroke_margin,
        pressure_pa=limits.pressure_pa,
        fallback=spec.fallback,
        load=spec.load,
        **most,
    )
    _check_pilots(plan, plant)
    return plan


def _sides(valves: ValveMap, axis: int) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
    extend, retract = ((valves.speeds[axis, side], valves.levers[axis, side]) for side in range(len(SIDES)))
    return extend, retract


def _lever_shape(machine: Machine) -> tuple[float, float, float]:
    _, plant = pack(machine)
    return machine.valves.pilot_pressure, float(plant[at.LEVER_DEAD_ZONE]), float(plant[at.CONFLUX_START])


def _pilots(machine: Machine, names: tuple[str, ...]) -> tuple[PilotCommand, ...]:
    """Return how each command of a twin follows from the levers: two per spool, primary before conflux spools."""
    axes, _ = pack(machine)
    pilots = []
    for name in names:
        spool, way = divmod(PILOTS.index(name), 2)
        axis, second = spool % AXES, spool >= AXES
        share = axes[axis, at.CONFLUX_SHARE_RETRACT if way else at.CONFLUX_SHARE_EXTEND] if second else 1.0
        pilots.append(PilotCommand(axis, second, way == 0, float(share)))
    return tuple(pilots)


def _check_pilots(plan: PlanParts, plant: PlantInterface) -> None:
    """Raise an error if the pilot pressures of a plant differ from the pilot pressures of its machine.

    Raises:
        ExportError: it is one.
    """
    levers = np.random.default_rng(0).uniform(-1.0, 1.0, (50, AXES))
    full, zone, start = plan.lever_shape
    expected = plant.commands(levers)
    names = [channel.name for channel in plan.plant.inputs[: len(plan.pilots)]]
    for pilot, name in zip(plan.pilots, names, strict=True):
        lever = levers[:, pilot.axis]
        demand = np.clip((np.abs(lever) - zone) / (1.0 - zone), 0.0, 1.0)
        if pilot.second:
            demand = pilot.share * np.clip((demand - start) / (1.0 - start), 0.0, 1.0)
        pressure = np.where((lever >= 0.0) == pilot.extend, full * demand, 0.0)
        if np.abs(pressure - expected[:, PILOTS.index(name)]).max() > 1e-3 * full:
            raise ExportError(
                f"{plant.source} makes other pilot pressures '{name}' of levers than machine "
                f"'{plant.geometry.machine.name}' does; a controller in C follows the machine: use its own"
            )


def golden_loop(parts: ControllerParts, stored: KeptController) -> GoldenLoop | None:
    """Return the stored segment before the first tick with a missing input; None if the first tick has one."""
    columns = stored.plant.columns(tuple(channel.name for channel in parts.inputs))
    measured = stored.observed[:, columns]
    good: NDArray[np.bool_] = np.asarray(np.isfinite(measured).all(axis=1))
    ticks = len(good) if good.all() else int(np.argmin(good))
    if not ticks:
        return None
    ahead = parts.lead if parts.plan is None else max(parts.lead, sum(parts.plan.blocks))
    # Two more rows: slopes are central.
    rows = slice(0, ticks + ahead + 2)
    before, levers = _replay(stored, ticks)
    return GoldenLoop(measured[:ticks], before, levers, stored.strokes[rows], stored.tip[rows])


def _replay(stored: KeptController, ticks: int) -> tuple[Array, Array]:
    """Return memory before each tick and levers of the controller under the stored observations."""
    experiment = stored.experiment
    controller = experiment.controller.build(stored.plant, experiment.task.limits, stored.models)
    if not isinstance(controller, PiController | NmpcController):
        raise ExportError("the controller has no form in C; these have: pi, nmpc")
    judged = np.ones(len(stored.strokes), dtype=bool)
    controller.reset(stored.observed[0], TipReference(stored.plant.rate_hz, stored.strokes, stored.tip, judged))
    before, levers = [], []
    for tick in range(ticks):
        before.append(np.concatenate((controller.before, controller.memory)))
        levers.append(controller.step(stored.observed[tick], tick))
    return np.array(before), np.array(levers)


def _most(options: Mapping[str, object]) -> dict[str, int]:
    most = dict(MOST)
    for option, value in options.items():
        if option not in MOST:
            raise ConfigError(
                f"--set {option}: a controller has no such option (it has {' and '.join(MOST)}); leave it out"
            )
        text = str(value)
        if not text.isdecimal() or not 2 <= int(text) <= MAX_ITERATIONS:
            raise ConfigError(f"--set {option}={text}: an integer from 2 to {MAX_ITERATIONS:,} must hold")
        most[option] = int(text)
    return most
