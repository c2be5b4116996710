"""Contract of a twin: relation between commands, ports and state for any formulation."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels, twin_channels
from edp.errors import DataError
from edp.networks.twin import TWINS, Twin, TwinSpec, TwinState, fit_scales
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.testing.expectations import expect, expect_near

Array = NDArray[np.float32]
RATE_HZ = 50.0
BATCH, TICKS = 3, 24
FRONT_PILOTS = (("Bm", "Up"), ("Bm", "Dwn"), ("Am", "In"), ("Am", "Out"), ("Bkt", "In"), ("Bkt", "Out"))
FRONT_STROKES = (1.26, 1.504, 1.104)
"""m, of boom, arm and bucket: those of machine M22."""


def sample_actuators(
    ticks: int = 600, seed: int = 0, axes: int = 2, strokes: bool = True, pressures: bool = True
) -> Recording:
    """Return a recording of actuators with dead band, lag and end stops, each driven by its own lever.

    Args:
        ticks: length, at 50 Hz.
        seed: seed of the levers and of the sensor noise.
        axes: number of actuators.
        strokes: whether positions are measured.
        pressures: whether pressures are measured.
    """
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.uniform(-1, 1, (ticks // 25 + 1, axes)), 25, axis=0)[:ticks]
    velocity, stroke = np.zeros((ticks, axes)), np.full((ticks, axes), 0.5)
    for t in range(1, ticks):
        goal = 0.4 * np.sign(lever[t - 1]) * np.maximum(np.abs(lever[t - 1]) - 0.1, 0.0)
        velocity[t] = velocity[t - 1] + 0.2 * (goal - velocity[t - 1])
        stroke[t] = stroke[t - 1] + 0.5 * (velocity[t] + velocity[t - 1]) / RATE_HZ
        stopped = (stroke[t] < 0.0) | (stroke[t] > 1.0)
        stroke[t] = np.clip(stroke[t], 0.0, 1.0)
        velocity[t, stopped] = 0.0
    pressure = 1e7 + 5e6 * lever + 2e6 * velocity + rng.normal(0, 1e4, (ticks, axes))
    columns = [(Kind.RATIO, "lever", lever), (Kind.VELOCITY, "speed", velocity)]
    columns += [(Kind.POSITION, "stroke", stroke)] if strokes else []
    columns += [(Kind.PRESSURE, "pressure", pressure)] if pressures else []
    channels = tuple(Channel(f"{name}_{i + 1}", kind) for kind, name, _ in columns for i in range(axes))
    values = np.concatenate([column for _, _, column in columns], axis=1).astype(np.float32)
    return Recording(f"actuators_{seed}", channels, values, RATE_HZ, "sample")


def sample_front(ticks: int = 600, seed: int = 0) -> Recording:
    """Return a recording with the channels of an excavator front.

    Independent random levers, strokes and pressures, 50 Hz.

    Args:
        ticks: length.
        seed: seed of all values.
    """
    rng = np.random.default_rng(seed)
    lever = np.repeat(rng.uniform(-1.0, 1.0, (ticks // 25 + 1, 3)), 25, axis=0)[:ticks]
    pilots = np.stack([np.maximum(lever, 0.0), np.maximum(-lever, 0.0)], axis=2).reshape(ticks, 6)
    names = [(f"{axis}{way}", Kind.PILOT_PRESSURE) for axis, way in FRONT_PILOTS]
    names += [(f"CylVels_{i}", Kind.VELOCITY) for i in (1, 2, 3)]
    names += [(f"CylStroke_{i}", Kind.POSITION) for i in (1, 2, 3)]
    names += [(f"CylPressures_{i + side}", Kind.PRESSURE) for i in (1, 2, 3) for side in (0, 4)]
    names += [(f"PumpPressure_{i}", Kind.PRESSURE) for i in (1, 2)]
    phase = np.arange(ticks)[:, None] / RATE_HZ * np.array([0.7, 0.9, 1.1])
    stroke = np.array(FRONT_STROKES) * (0.5 + 0.48 * np.sin(phase))
    velocity = np.gradient(stroke, axis=0) * RATE_HZ
    pressures = rng.uniform(1e6, 2e7, (ticks, 8))
    values = np.concatenate([pilots, velocity, stroke, pressures], axis=1).astype(np.float32)
    channels = tuple(Channel(name, kind) for name, kind in names)
    return Recording(f"front_{seed}", channels, values, RATE_HZ, "sample")


def sample_twin(spec: TwinSpec, recording: Recording | None = None) -> tuple[Twin, Array, Array]:
    """Return a twin of sample actuators with commands and measured values ``(batch, tick, channel)``.

    Args:
        spec: the formulation; what needs training keeps the weights that it starts with.
        recording: recording for the fit; by default that of `sample_actuators`.
    """
    recording = recording or sample_actuators()
    channels = twin_channels(recording)
    series = [channels.task().series(recording)]
    twin = spec.start(channels, fit_scales(channels, series), series, seed=1)
    length = twin.prefix_ticks + TICKS
    starts = np.linspace(0, recording.samples - length, BATCH).astype(int)
    commands = np.stack([series[0].inputs[at : at + length] for at in starts])
    measured = np.stack([series[0].targets[at : at + length] for at in starts])
    return twin, commands, measured


def check_twin(name: str, options: TwinSpec | None = None, recordings: Sequence[Recording] = ()) -> None:
    """Check the contract of a registered formulation, for two actuators and for minimal sensors.

    Args:
        name: under which it is registered.
        options: options of the formulation; missing ones have their defaults.
        recordings: recordings to use instead, for options that need a particular machine.

    Raises:
        ContractError: the contract is violated; the message names the rule and the channels.
    """
    samples = (sample_actuators(), sample_actuators(axes=1, strokes=False, pressures=False))
    for recording in recordings or samples:
        spec: TwinSpec = options or TWINS[name]()
        twin, commands, measured = sample_twin(spec, recording)
        where = f"twin '{name}', {', '.join(channel.name for channel in twin.channels.answers)}"
        prefix = twin.prefix_ticks
        state = twin.reset(commands[:, :prefix], measured[:, :prefix])
        case = (twin, commands[:, prefix:], measured[:, prefix:], state)
        for check in (_chunks, _state_is_left, _causality, _ports, _lanes, _branches, _bounds, _refusals):
            check(*case, where)
        _arrays(spec, twin, commands[:, prefix:], state, where)


def _chunks(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    """Check that samples, chunks and continued runs equal the whole run bit for bit, in every mode."""
    mixed = np.where(np.random.default_rng(2).random(measured.shape) < 0.5, measured, np.nan).astype(np.float32)
    none, same = twin.rollout(commands[:, :0], state)
    expect(none.shape[1] == 0 and same is state, f"{where}: a run of no ticks changes the state")
    for mode, ports in (("free", None), ("measured", measured), ("mixed", mixed)):
        whole, _ = twin.rollout(commands, state, ports)
        first, later = twin.rollout(commands[:, :7], state, None if ports is None else ports[:, :7])
        later = {key: values.copy() for key, values in later.items()}
        second, _ = twin.rollout(commands[:, 7:], later, None if ports is None else ports[:, 7:])
        expect(np.array_equal(np.concatenate([first, second], axis=1), whole), f"{where}: {mode}: chunks differ")
        rows, now = [], state
        for t in range(commands.shape[1]):
            row, now = twin.step(commands[:, t], now, None if ports is None else ports[:, t])
            rows.append(row)
        expect(np.array_equal(np.stack(rows, axis=1), whole), f"{where}: {mode}: ticks differ from one run")


def _state_is_left(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    before = {key: values.copy() for key, values in state.items()}
    twin.rollout(commands, state)
    same = all(np.array_equal(state[key], before[key]) for key in before)
    expect(same and state.keys() == before.keys(), f"{where}: a run changes the state that it starts from")


def _causality(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    later = commands.copy()
    later[:, 10:] += 0.3
    whole, changed = (twin.rollout(rows, state)[0] for rows in (commands, later))
    expect(np.array_equal(whole[:, :10], changed[:, :10]), f"{where}: an answer depends on a later command")
    expect(not np.array_equal(whole[:, -1], changed[:, -1]), f"{where}: no answer depends on the commands")


def _ports(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    """Check that a free port reads the last output only, and a measured port does not."""
    free, _ = twin.rollout(commands, state)
    fed = np.concatenate([np.full_like(free[:, :1], np.nan), free[:, :-1]], axis=1)
    again, _ = twin.rollout(commands, state, fed)
    scale = twin.scales.answer_width
    message = f"{where}: its own answers, fed as measured, give other ones"
    expect_near(again / scale, free / scale, message, rtol=0.0, atol=1e-3)
    one, _ = twin.rollout(commands, state, measured)
    other, _ = twin.rollout(commands, state | {"answer": state["answer"] * np.float32(0.9)}, measured)
    expect(np.array_equal(one, other), f"{where}: a measured port reads the last answer")
    if twin.channels.strokes:
        shifted, _ = twin.rollout(commands, state, measured + 0.05 * scale)
        expect(not np.array_equal(one, shifted), f"{where}: no answer depends on what is measured")


def _lanes(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    whole, _ = twin.rollout(commands, state)
    alone, _ = twin.rollout(commands[1:2], {key: values[1:2] for key, values in state.items()})
    scale = twin.scales.answer_width
    message = f"{where}: a lane depends on the lanes beside it"
    expect_near(alone[0] / scale, whole[1] / scale, message, rtol=0.0, atol=1e-3)


def _branches(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    """Check that branching runs equal separate runs from the same state."""
    first = np.array([0, 0, 5, 9])
    runs = np.repeat(commands[:1], len(first), axis=0)
    for run, tick in enumerate(first[1:], start=1):
        runs[run, tick:] = commands[1, tick:]
    start = {key: values[:1] for key, values in state.items()}
    row = measured[0, 0].copy()
    row[-1] = np.nan
    fed = np.full((len(first), *measured.shape[1:]), np.nan, np.float32)
    fed[:, 0] = row
    whole, _ = twin.rollout(runs, {key: np.repeat(values, len(first), 0) for key, values in start.items()}, fed)
    before = {key: values.copy() for key, values in start.items()}
    runner = twin.runner()
    branched, again = twin.branches(runs, start, row, first), runner.branches(runs, start, row, first)
    scale = twin.scales.answer_width
    expect_near(branched / scale, whole / scale, f"{where}: a branch differs from a run of its own", 0.0, 1e-3)
    expect_near(again / scale, branched / scale, f"{where}: branches of its runner are others", 0.0, 1e-3)
    _, stepped = twin.step(runs[:1, 0], start, row[None])
    ready = runner.step(runs[0, 0], start, row)
    one, other = (twin.rollout(runs[:1, 1:], state)[0] for state in (stepped, ready))
    expect_near(other / scale, one / scale, f"{where}: a step of its runner leads elsewhere", 0.0, 1e-3)
    same = all(np.array_equal(start[key], before[key]) for key in before)
    expect(same, f"{where}: branches change the state that they start from")


def _bounds(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    """Check that outputs stay within bounds for any command, and that a stroke is the integral of its velocity."""
    for command in (-1e3, 1e3):
        answers, _ = twin.rollout(np.full_like(commands, command), state)
        slack = 1e-5 * (twin.scales.high - twin.scales.low)
        inside = (answers >= twin.scales.low - slack) & (answers <= twin.scales.high + slack)
        expect(bool(inside.all()), f"{where}: an answer leaves the bounds at a command of {command:g}")
    answers, _ = twin.rollout(commands, state)
    count, strokes = len(twin.channels.velocities), len(twin.channels.strokes)
    if strokes:
        velocity, stroke = answers[..., :count].astype(np.float64), answers[..., count : 2 * count]
        low, high = twin.scales.low[count : 2 * count], twin.scales.high[count : 2 * count]
        moved = stroke[:, :-1] + 0.5 * (velocity[:, 1:] + velocity[:, :-1]) / twin.channels.rate_hz
        between = (stroke[:, 1:] > low + 1e-4) & (stroke[:, 1:] < high - 1e-4)
        difference = np.where(between, moved - stroke[:, 1:], 0.0)
        expect_near(difference, 0.0 * difference, f"{where}: a stroke is not the integral of its velocity", 0.0, 1e-5)


def _arrays(spec: TwinSpec, twin: Twin, commands: Array, state: TwinState, where: str) -> None:
    """Check that `arrays` matches `shapes`, and that `build` restores an equal twin from it."""
    arrays = twin.arrays()
    shapes = {key: values.shape for key, values in arrays.items() if key not in twin.scales.arrays()}
    expect(shapes == dict(spec.shapes(twin.channels)), f"{where}: its arrays have other shapes than it announces")
    copied = {key: values.copy() for key, values in arrays.items()}
    again = spec.build(twin.channels, type(twin.scales).from_arrays(copied), copied)
    same = np.array_equal(again.rollout(commands, state)[0], twin.rollout(commands, state)[0])
    expect(same, f"{where}: built from its arrays it answers otherwise")


def _refusals(twin: Twin, commands: Array, measured: Array, state: TwinState, where: str) -> None:
    gap, prefix = commands.copy(), twin.prefix_ticks
    gap[0, 3, 0] = np.nan
    long_commands, long_measured = (np.repeat(rows[:, :1], prefix, axis=1) for rows in (commands, measured))
    unknown = long_measured.copy()
    unknown[:, 0, 0] = np.nan
    calls: dict[str, Callable[[], object]] = {
        "a gap in the commands": lambda: twin.rollout(gap, state),
        "a prefix that is too short": lambda: twin.reset(long_commands[:, :-1], long_measured[:, :-1]),
        "a port of which nothing is measured": lambda: twin.reset(long_commands, unknown),
        "commands of another shape": lambda: twin.rollout(commands[..., :0], state),
    }
    if twin.channels.strokes:
        beyond = long_measured.copy()
        beyond[..., len(twin.channels.velocities)] = 10.0
        calls["a start beyond an end stop"] = lambda: twin.reset(long_commands, beyond)
    for what, call in calls.items():
        try:
            call()
        except DataError:
            continue
        expect(False, f"{where}: takes {what}")


def sample_series(count: int) -> tuple[TwinChannels, list[Series]]:
    """Return the several sample recordings as series of a twin."""
    recordings = [sample_actuators(seed=seed) for seed in range(count)]
    channels = twin_channels(recordings[0])
    return channels, [channels.task().series(recording) for recording in recordings]
