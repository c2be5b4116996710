"""Motors of grey boxes: exact tangents, a turning without end, and a machine simulated otherwise that a fit finds."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import odeint

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError
from edp.networks.twin import TWINS, fit_scales
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.datasheet import datasheet
from edp.networks.twin.grey.elements import CylinderElement, MotorElement, PumpElement, ValveElement
from edp.networks.twin.grey.rollouts import RunBatch
from edp.networks.twin.greybox import GreyBox, GreyFitSpec, RunTarget
from edp.networks.twin.residual import Residual
from edp.signals import Channel, Kind
from edp.training.grey_fit import fit_grey_box

PREFIX = 30
RAM = CylinderElement(name="ram", velocity="speed", head="head", rod="rod", bore=0.1, rod_diameter=0.06)
SWING = MotorElement(name="swing", velocity="turning", a="left", b="right", displacement=2e-3)
ARM = GreyBox(
    cylinders=(RAM,),
    motors=(SWING,),
    valves=(
        ValveElement(name="valve", actuator="ram", extend="lever", supply="pump"),
        ValveElement(name="turn", actuator="swing", extend="pedal", supply="pump"),
    ),
    pumps=(PumpElement(name="pump", pressure="line"),),
    inertia_degree=1,
    potential_degree=2,
    prefix_ticks=PREFIX,
)


def arm_channels():
    """A ram and a swing drive with all sensors, at 100 Hz."""
    return TwinChannels(
        (Channel("lever", Kind.RATIO), Channel("pedal", Kind.RATIO)),
        (Channel("speed", Kind.VELOCITY), Channel("turning", Kind.ANGULAR_VELOCITY)),
        (Channel("height", Kind.POSITION), Channel("heading", Kind.ANGLE)),
        tuple(Channel(name, Kind.PRESSURE) for name in ("head", "rod", "left", "right", "line")),
        100.0,
    )


def arm(spec=ARM, seed=0):
    """A machine of known numbers whose swing has more inertia the farther the ram is out, and levers for it."""
    rng = np.random.default_rng(seed)
    levers = np.repeat(rng.uniform(-1, 1, (21, 2)), 40, axis=0)[:800]
    low = np.array([-0.5, -1.0, 0.0, -2.0, 0.0, 0.0, 0.0, 0.0, 1e6])
    high = np.array([0.5, 1.0, 1.0, 2.0, 2e7, 2e7, 2e7, 2e7, 2e7])
    series = Series("levers", levers.astype(np.float32), rng.uniform(low, high, (800, 9)).astype(np.float32))
    channels = arm_channels()
    twin = spec.start(channels, fit_scales(channels, [series]), [series], 0)
    table, numbers = twin.table, twin.table.nominal
    names = [number.name for number in table.numbers]
    numbers[names.index("inertia_root_ram_ram_00")] = 0.07
    numbers[names.index("inertia_root_swing_swing_00")] = 0.015  # 225 kg m^2
    numbers[names.index("inertia_root_swing_swing_10")] = 0.004
    numbers[names.index("inertia_root_swing_ram_00")] = 0.001
    return twin.with_parameters(numbers), levers[None].astype(np.float32)


START = np.array([[0.0, 0.0, 0.5, 0.3, 5e6, 5e6, 5e6, 5e6, 5e6]], np.float32)


def loss(twin, numbers, commands, truth, columns):
    """Loss of a free run, its gradient on request."""
    values = truth / twin.units
    measured = values[:, :-1].copy()
    measured[:, PREFIX + 1 :] = np.nan
    demands = twin.demands(commands[:, :-1])
    rest = twin.rest(demands[:, 0], truth[:, 0])
    state = (measured[:, 0].copy(), *(np.ascontiguousarray(part, dtype=np.float64) for part in rest))
    weight = twin.units / twin.scales.answer_width.astype(np.float64)
    target = RunTarget(np.ascontiguousarray(values[:, 1:]), weight, 1e9, PREFIX)
    normal = twin.evaluate_runs(numbers, RunBatch(demands, measured, *state), target, columns > 0)
    return normal.losses.sum(), normal.gradient


@pytest.mark.long
@pytest.mark.parametrize("by_angle", [False, True])
def test_tangents_are_those_of_differences_with_a_motor(by_angle):
    twin, commands = arm(replace(ARM, motors=(replace(SWING, load_by_angle=by_angle),)))
    answers, _ = twin.rollout(commands, twin.initial_state(commands[:, 0], START))
    rows = np.concatenate([START[:, None], answers], axis=1)[:, : PREFIX + 10]
    table, rng = twin.table, np.random.default_rng(1)
    moved = np.exp(rng.normal(0, 0.1, len(twin.numbers)))
    numbers = np.where(table.positive, twin.numbers * moved, twin.numbers)
    # Away from a whole number of ticks, where the interpolated dead time has a corner.
    numbers[table.valve_at[:, at.DELAY]] = 0.0363
    span = commands[:, : PREFIX + 10]
    _, gradient = loss(twin, numbers, span, rows, len(numbers))
    size = np.where(table.positive, np.abs(numbers), table.width)
    size[table.priors.leader != np.arange(len(numbers))] = numbers[table.actuator_at[1] + at.ROD_AREA]
    apart = []
    for which in np.flatnonzero(size):
        step = np.zeros(len(numbers))
        step[which] = 1e-5 * size[which]
        above, below = (loss(twin, numbers + sign * step, span, rows, 0)[0] for sign in (1, -1))
        apart.append(gradient[which] * size[which] - (above - below) / 2e-5)
    assert np.abs(apart).max() < 2e-4 * np.abs(gradient * size).max()
    own = slice(table.actuator_at[1], table.actuator_at[1] + at.ACTUATOR_VALUES)
    assert np.count_nonzero(gradient[own]) >= 10


def test_a_motor_turns_without_end_and_its_load_follows_the_strokes_of_others():
    twin, _ = arm()
    commands = np.zeros((2, 1500, 2), np.float32)
    commands[:, :, 1] = np.array([0.5, -0.5])[:, None]
    answers, _ = twin.rollout(commands, twin.initial_state(0 * commands[:, 0], START.repeat(2, axis=0)))
    turned = answers[:, -1, 3] - START[0, 3]
    # Seen were two radians either way; a cylinder would have stopped there.
    assert turned[0] > 3.0
    assert turned[1] < -3.0
    assert np.ptp(answers[:, -200:, 1], axis=1).max() < 0.05 * np.abs(answers[:, -1, 1]).min()
    # Neither the volume of a chamber nor the load knows the angle: turned by 100 rad, it does the same.
    elsewhere = START + 100.0 * np.eye(9, dtype=np.float32)[3]
    pair = np.concatenate([START, elsewhere])
    both, _ = twin.rollout(commands[:1, :300].repeat(2, axis=0), twin.initial_state(0 * commands[:, 0], pair))
    np.testing.assert_allclose(both[1, :, 3] - both[0, :, 3], 100.0, atol=1e-3)
    np.testing.assert_array_equal(np.delete(both[0], 3, axis=1), np.delete(both[1], 3, axis=1))
    # With the ram far out there is more to turn: a heavy superstructure is slower to follow.
    names, numbers = [number.name for number in twin.table.numbers], twin.numbers.copy()
    numbers[names.index("inertia_root_swing_swing_00")] = 0.08
    numbers[names.index("inertia_root_swing_swing_10")] = 0.04
    heavy = twin.with_parameters(numbers)
    out = np.concatenate([START, START]) + np.array([[-0.4], [0.4]], np.float32) * np.eye(9, dtype=np.float32)[2]
    both, _ = heavy.rollout(commands[:1, :300].repeat(2, axis=0), heavy.initial_state(0 * commands[:, 0], out))
    assert both[1, 10:30, 1].mean() < 0.7 * both[0, 10:30, 1].mean()


def test_an_untrained_network_on_a_grey_box_with_a_motor_is_that_grey_box():
    grey, commands = arm()
    elements = {name: getattr(ARM, name) for name in ("cylinders", "motors", "valves", "pumps")}
    spec = Residual(**elements, inertia_degree=1, potential_degree=2, units=5)
    twin, _ = arm(spec)
    alone, both = (one.rollout(commands, one.initial_state(commands[:, 0], START))[0] for one in (grey, twin))
    np.testing.assert_array_equal(alone, both)
    again = spec.build(twin.channels, twin.scales, twin.arrays())
    np.testing.assert_array_equal(again.rollout(commands, again.initial_state(commands[:, 0], START))[0], both)


SUPPLY, TANK, RELIEF = 20e6, 0.2e6, 26e6
DISPLACEMENT, INERTIA, LINE = 1e-4, 20.0, 0.8e-3
"""m^3/rad (628 ml a turn), kg m^2, and m^3 of each side."""
BULK, INTERNAL, EXTERNAL = 1.2e9, 2e-11, 2e-12
COULOMB, VISCOUS = 40.0, 8.0


def orifice(area, dp):
    """Flow through an opening, smooth near zero."""
    return area * dp / np.sqrt(np.abs(dp) + 1e4)


def slope(_, x, lever):
    """Motor behind a spool: two lags, spool, velocity, both pressures; SI units, nothing taken from the grey box."""
    pilot, spool, speed, a, b = x
    opened = np.sign(spool) * max(abs(spool) - 0.1, 0.0) / 0.9
    area = 9e-7 * abs(opened) * (0.3 + 0.7 * abs(opened))
    fed, other = (a, b) if opened >= 0 else (b, a)
    # A load check bars the way back to the supply.
    into = orifice(area, max(SUPPLY - fed, 0.0))
    out = orifice(1.2 * area, other - TANK)
    flows = np.array([into, -out] if opened >= 0 else [-out, into])
    leak = INTERNAL * (a - b)
    flows += np.array([-leak, leak]) - EXTERNAL * np.array([a, b])
    for side, pressure in enumerate((a, b)):
        flows[side] += orifice(4e-6, max(TANK - pressure, 0.0)) - 3e-9 * max(pressure - RELIEF, 0.0)
    torque = DISPLACEMENT * (a - b) - COULOMB * np.tanh(speed / 0.2) - VISCOUS * speed
    pressures = BULK / LINE * (flows - DISPLACEMENT * speed * np.array([1.0, -1.0]))
    return [(lever - pilot) / 0.03, (pilot - spool) / 0.03, torque / INERTIA, *pressures]


MOTOR = TwinChannels(
    (Channel("pedal", Kind.RATIO),),
    (Channel("turning", Kind.ANGULAR_VELOCITY),),
    (),
    (Channel("left", Kind.PRESSURE), Channel("right", Kind.PRESSURE)),
    100.0,
)


def motor_log(seed, ticks=1200):
    """A recording of the independent motor."""
    rng = np.random.default_rng(seed)
    steps = [(rng.uniform(-1, 1) * (rng.random() > 0.2), rng.integers(15, 80)) for _ in range(ticks // 15)]
    lever = np.concatenate([np.full(length, height) for height, length in steps])[:ticks]
    lever = np.convolve(np.pad(lever, (19, 0)), np.full(20, 0.05), "valid")  # a hand needs 0.2 s
    rows, x = [], np.array([0.0, 0.0, 0.0, 5e6, 5e6])
    for height in lever:
        rows.append(x[2:])
        # LSODA by its short way: a tick is a step or two, beside which the objects of `solve_ivp` take most time.
        x = odeint(slope, x, (0.0, 0.01), args=(height,), rtol=1e-6, atol=1e-6, tfirst=True)[-1]
    return Series(f"log {seed}", lever[:, None].astype(np.float32), np.array(rows, np.float32))


FITTED = GreyBox(
    motors=(MotorElement(name="motor", velocity="turning", a="left", b="right", displacement=DISPLACEMENT),),
    valves=(ValveElement(name="valve", actuator="motor", extend="pedal", regeneration=False),),
    prefix_ticks=PREFIX,
    fit=GreyFitSpec(
        lengths_s=(0.1, 0.3, 1.0), rounds=(8, 6, 4), final_rounds=0, starts=1, batch=64, ticks=3000, validation_runs=8
    ),
)


def free_errors(twin, log, ticks=300):
    """Mean absolute errors of each answer over free runs in a recording."""
    starts, prefix = range(0, log.samples - ticks - twin.prefix_ticks, 200), twin.prefix_ticks
    commands = np.stack([log.inputs[at : at + prefix + ticks] for at in starts])
    truth = np.stack([log.targets[at : at + prefix + ticks + 1] for at in starts])
    state = twin.reset(commands[:, :prefix], truth[:, :prefix])
    answers, _ = twin.rollout(commands[:, prefix:], state)
    return np.abs(answers - truth[:, prefix + 1 :]).mean(axis=(0, 1))


@pytest.mark.long
def test_a_motor_that_was_simulated_otherwise_is_found():
    """Displacement told: then inertia and supply are within 5 %, and free runs far better than the map's."""
    logs = [motor_log(seed) for seed in range(5)]
    scales = fit_scales(MOTOR, logs[:3])
    twin = FITTED.start(MOTOR, scales, logs[:3], 0)
    # The balance of torques alone finds the inertia: no angle is measured, and none is needed.
    assert twin.numbers[twin.table.inertia_at] ** 2 * 1e6 == pytest.approx(INERTIA, rel=0.1)
    result = fit_grey_box(twin, logs[:3], logs[3:4], seed=0)
    fitted, table = result.twin, result.twin.table
    rows = {row.name: row for row in datasheet(table, fitted.numbers, result.information)}
    assert rows["inertia_motor"].value == pytest.approx(INERTIA, rel=0.05)
    assert rows["displacement"].value == pytest.approx(DISPLACEMENT, rel=0.02)
    assert rows["supply"].value == pytest.approx(SUPPLY, rel=0.05)
    place = table.actuator_at[0]
    assert fitted.numbers[place + at.ROD_AREA] == fitted.numbers[place + at.HEAD_AREA] != twin.numbers[place]
    fixed = [k for k in range(at.ACTUATOR_VALUES) if table.numbers[place + k].width == 0.0 and k != at.ROD_AREA]
    assert fixed == [at.CUSHION_LENGTH, at.CUSHION_LEAST, at.STOP_LOW, at.STOP_HIGH, at.STOP_STIFFNESS]
    np.testing.assert_array_equal(fitted.numbers[place + np.array(fixed)], twin.numbers[place + np.array(fixed)])
    static = TWINS["static"]().start(MOTOR, scales, logs[:4], 0)
    assert (free_errors(fitted, logs[4]) < 0.25 * free_errors(static, logs[4])).all()


def test_the_datasheet_of_a_motor_has_units_of_turning():
    twin, _ = arm()
    rows = datasheet(twin.table, twin.numbers, np.zeros((len(twin.numbers),) * 2))
    units = {row.name: row.unit for row in rows if row.element == "swing"}
    assert units == {
        "displacement": "m^3/rad", "volume_a": "m^3", "volume_b": "m^3", "internal_leakage": "m^3/s/Pa",
        "external_leakage": "m^3/s/Pa", "relief_a": "Pa", "relief_b": "Pa", "coulomb": "N m",
        "static_less_coulomb": "N m", "stribeck": "rad/s", "viscous": "N m s/rad", "bristle_stiffness": "N m/rad",
        "bristle_damping": "N m s/rad", "friction_asymmetry": "N m",
    }  # fmt: skip
    load = {row.name: row for row in rows if row.element == "load"}
    assert load["inertia_ram"].unit == "kg"
    assert load["inertia_ram"].value == pytest.approx(4900.0, rel=1e-5)
    assert load["inertia_swing"].unit == "kg m^2"
    assert load["inertia_swing"].value == pytest.approx(226.0, rel=1e-5)
    assert load["inertia_root_swing_swing_10"].unit == "kg^0.5 m"
    # The interval of what the data say nothing of is the plausible one, here beyond zero.
    assert load["inertia_swing"].low == 0.0
    assert not load["inertia_swing"].excited
    # The load does not know the angle of the swing.
    assert not twin.table.exponents[:, 1].any()
    assert {name for name in load if name.startswith("potential")} == {"potential_10", "potential_20"}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"velocity": "turnnig"}, r"port 'velocity' of motor 'swing' is 'turnnig', which is no velocity.*turning"),
        (
            {"velocity": "speed"},
            r"motor 'swing' is 'speed' of kind velocity \(m/s\); angular_velocity must hold.*cylin",
        ),
        ({"a": "lefd"}, r"port 'a' of motor 'swing' is 'lefd', which is no pressure of this twin.*left"),
        ({"b": "left"}, r"'left' is connected to motor 'swing' and to motor 'swing', port 'b'"),
        ({"b": "rod"}, r"'rod' is connected to cylinder 'ram' and to motor 'swing', port 'b'"),
        ({"angle": "height"}, r"port 'angle' of motor 'swing' is 'height', but the position .*'turning' is 'heading'"),
        ({"b": ""}, r"no element has the channel 'right'"),
        ({"name": "ram"}, r"two elements of kind actuator are called 'ram'"),
        ({"name": "slew"}, r"port 'actuator' of valve 'turn' is 'swing', which is no cylinder or motor of this twin"),
    ],
)
def test_a_motor_that_does_not_connect_is_named(changes, message):
    with pytest.raises(ConfigError, match=message):
        replace(ARM, motors=(replace(SWING, **changes),)).shapes(arm_channels())


def test_an_angular_velocity_is_no_cylinders_and_a_motor_needs_a_valve_and_an_angle_for_its_load():
    turned = replace(RAM, velocity="turning", head="left", rod="right", name="swing")
    with pytest.raises(
        ConfigError, match=r"cylinder 'swing' is 'turning' of kind angular_velocity \(rad/s\); velocity "
    ):
        replace(ARM, cylinders=(RAM, turned), motors=()).shapes(arm_channels())
    with pytest.raises(ConfigError, match=r"motor 'swing' has no valve"):
        replace(ARM, valves=ARM.valves[:1]).shapes(arm_channels())
    with pytest.raises(
        ConfigError, match=r"load of motor 'motor' is to depend on its angle, but this twin has no stro"
    ):
        replace(FITTED, motors=(replace(FITTED.motors[0], load_by_angle=True),)).shapes(MOTOR)
    with pytest.raises(ConfigError, match=r"motor 'swing'.*displacement.*-1"):
        replace(SWING, displacement=-1.0)
    with pytest.raises(ConfigError, match=r"motor 'swing'.*count"):
        replace(SWING, count=0)
    assert replace(SWING, count=2).areas == (4e-3, 4e-3)


def test_an_angular_velocity_becomes_a_motor_where_no_elements_are_named():
    elements = GreyBox().elements(replace(arm_channels(), pressures=()))
    assert [one.name for one in elements.cylinders] == ["speed"]
    assert [(one.velocity, one.load_by_angle) for one in elements.motors] == [("turning", True)]
    assert [(valve.actuator, valve.extend) for valve in elements.valves] == [("speed", "lever"), ("turning", "pedal")]
    (motor,) = GreyBox().elements(MOTOR).motors
    assert (motor.a, motor.b, motor.load_by_angle) == ("left", "right", False)


def test_numbers_of_a_file_that_give_a_motor_two_displacements_are_refused():
    twin, _ = arm()
    arrays = twin.arrays()
    arrays["numbers"][twin.table.actuator_at[1] + at.ROD_AREA] *= 1.5
    with pytest.raises(ValueError, match="have not the same displacement"):
        ARM.build(twin.channels, twin.scales, arrays)
    assert ARM.build(twin.channels, twin.scales, twin.arrays()).scales.high[3] == 1e6
