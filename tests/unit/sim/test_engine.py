"""An engine with droop: balance of energy, speed under load, limits, and nothing where there is none."""

from importlib import resources

import numpy as np
import pytest
from snapshots import check_snapshot

from edp.errors import ConfigError
from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.machine_files import parse_machine
from edp.sim.machine.parameters import pack
from edp.sim.physics import engine
from edp.sim.physics.plant import Plant

TEXT = resources.files("edp.sim").joinpath("machines", "m22.toml").read_text(encoding="utf-8")
NUMBERS = {"engine_droop": 0.08, "engine_power": 118e3, "engine_inertia": 3.0, "engine_speed_rpm": 1900.0}
"""Of a 22 t machine: 118 kW for pumps of 108 kW, 8 % droop; E, as the numbers around them."""


def text_with(**changes) -> str:
    lines = "\n".join(f"{key} = {value!r}" for key, value in {**NUMBERS, **changes}.items())
    return TEXT.replace("[pumps]\n", f"[pumps]\n{lines}\n")


@pytest.fixture
def drooping():
    return parse_machine(text_with(), "mine.toml")


def row_of(pressure: float, displacement: float) -> np.ndarray:
    row = np.zeros(at.LOG_COLUMNS)
    row[at.PUMP : at.PUMP + 2], row[at.DISPLACEMENT : at.DISPLACEMENT + 2] = pressure, displacement
    return row


def engine_power(plant) -> float:
    return plant[at.ENGINE_POWER] * np.clip((1.0 - plant[at.ENGINE_SPEED]) / plant[at.ENGINE_DROOP], 0.0, 1.0)


def test_a_step_keeps_the_balance_of_energy(drooping):
    """E (n'^2 - n^2) / 2 = h (P_engine(n') - P_load), for loads from none to more than the engine has."""
    _, plant = pack(drooping)
    draws = np.random.default_rng(0)
    for _ in range(500):
        row = row_of(draws.uniform(-1e5, 3.4e7), draws.uniform(0.1, 1.0))
        before, load = plant[at.ENGINE_SPEED], engine.load_power(row, plant)
        engine.turn(row, plant, 0.01)
        gained = 0.5 * plant[at.ENGINE_ENERGY] * (plant[at.ENGINE_SPEED] ** 2 - before**2)
        assert plant[at.ENGINE_SPEED] > engine.MIN_SPEED
        assert gained == pytest.approx(0.01 * (engine_power(plant) - load), rel=1e-9, abs=1e-6)
        assert plant[at.MAX_FLOW] == plant[at.RATED_FLOW] * plant[at.ENGINE_SPEED]


def test_speed_settles_on_the_governor_s_line_and_recovers(drooping):
    _, plant = pack(drooping)
    for _ in range(300):
        engine.turn(row_of(1.2e7, 0.9), plant, 0.01)
    load = engine.load_power(row_of(1.2e7, 0.9), plant)
    share = NUMBERS["engine_droop"] * load / NUMBERS["engine_power"]
    assert plant[at.ENGINE_SPEED] == pytest.approx(1.0 - share, abs=1e-6)
    for _ in range(300):
        engine.turn(row_of(0.0, 0.2), plant, 0.01)
    assert plant[at.ENGINE_SPEED] == pytest.approx(1.0, abs=1e-6)


def test_a_stalled_engine_is_held_at_its_least_speed(drooping):
    _, plant = pack(drooping)
    for _ in range(2000):
        engine.turn(row_of(2e8, 1.0), plant, 0.01)
        assert np.isfinite(plant[at.ENGINE_SPEED])
    assert plant[at.ENGINE_SPEED] == engine.MIN_SPEED


def test_without_droop_nothing_turns():
    plant = Plant(load_machine("M22"), np.full(3, 0.5))
    plant.run(np.tile([0.9, -0.9, 0.9], (60, 1)))
    assert plant.engine_speed == 1.0
    assert plant.plant[at.MAX_FLOW] == load_machine("M22").pumps.max_flow


def test_all_levers_slow_the_engine_and_the_machine(drooping):
    """Under full levers the engine falls below its governed speed, within droop, and cylinders go less far."""
    levers, ways = np.tile([0.9, -0.9, 0.9], (120, 1)), []
    for machine in (load_machine("M22"), drooping):
        plant = Plant(machine, np.full(3, 0.5))
        before = plant.strokes
        log = plant.run(levers)
        ways.append(np.abs(plant.strokes - before).sum())
    load = engine.load_power(log[-1], plant.plant)
    expected = 1.0 - NUMBERS["engine_droop"] * load / NUMBERS["engine_power"]
    assert plant.engine_speed == pytest.approx(expected, abs=5e-3)
    assert plant.engine_speed < 0.99
    assert 0.9 * ways[0] < ways[1] < ways[0]


def test_a_snapshot_holds_the_speed(tmp_path):
    plant = check_snapshot(tmp_path, text_with()).plant
    assert plant.engine_speed != 1.0


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"engine_droop": 0.0}, "engine_droop must be above 0"),
        ({"engine_inertia": 0.0, "engine_speed_rpm": 0.0}, "engine_inertia, engine_speed_rpm must be above 0"),
        ({"engine_power": 9e4}, "must be at least power_limit"),
        ({"engine_droop": 0.9}, "from 0 to 0.5"),
        ({"engine_inertia": -1.0}, "engine_inertia = -1.0"),
        ({"engine_power": float("inf")}, "engine_power = inf"),
        ({"engine_power": "much"}, "no number"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        parse_machine(text_with(**changes), "mine.toml")
