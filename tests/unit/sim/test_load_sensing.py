"""Pumps that sense loads: margin, standby, stall, want of oil by kind of sharing, balance of energy, refusals."""

import dataclasses
from importlib import resources

import numpy as np
import pytest
from snapshots import check_snapshot

from edp.errors import ConfigError
from edp.sim import load_machine
from edp.sim.machine import layout as at
from edp.sim.machine.machine_checks import check_machine
from edp.sim.machine.machine_files import parse_machine
from edp.sim.physics import hydraulics, pump
from edp.sim.physics.plant import Plant

TEXT = resources.files("edp.sim").joinpath("machines", "m22.toml").read_text(encoding="utf-8")
MARGIN, COMPENSATOR = 30e5, 20e5
SHARING = ("parallel", "compensated", "pre_compensated")


def sensing(sharing="compensated", margin=MARGIN, **pumps):
    machine = load_machine("M22")
    drop = COMPENSATOR if sharing == "pre_compensated" else 0.0
    given = {"load_margin": margin, "bypass": (4.0, 20.0), "min_displacement": 0.01, **pumps}
    machine = dataclasses.replace(
        machine,
        pumps=dataclasses.replace(machine.pumps, **given),
        valves=dataclasses.replace(machine.valves, flow_sharing=sharing, compensator_drop=drop),
    )
    check_machine(machine, "mine.toml")
    return machine


def speeds(log):
    return log[:, at.LOG_VELOCITY : at.LOG_VELOCITY + 3]


def test_pumps_stand_by_at_their_margin_and_swing_back():
    """At rest the bleed alone flows: both lines stand a margin above the tank, less the droop for that flow."""
    plant = Plant(sensing(), np.full(3, 0.5))
    log = plant.run(np.zeros((200, 3)))
    tank, bleed = plant.plant[at.TANK], plant.plant[at.BYPASS]
    for m in range(2):
        pressure, displacement = log[-1, at.PUMP + m], log[-1, at.DISPLACEMENT + m]
        assert pressure == pytest.approx(tank + MARGIN * (1.0 - pump.DROOP * displacement), rel=1e-3)
        supply = plant.plant[at.EFFICIENCY] * plant.plant[at.MAX_FLOW] * displacement
        assert supply == pytest.approx(hydraulics.orifice(pressure - tank)[0] * bleed, rel=1e-3)


@pytest.mark.parametrize("sharing", SHARING)
def test_one_lever_moves_its_load_with_the_margin_alone(sharing):
    """Arm out below full flow: its pump stays within the droop above the load, and takes less than half the power."""
    lever, powers = np.tile([0.0, -0.35, 0.0], (150, 1)), {}
    for name, machine in (("sensing", sensing(sharing)), ("positive", load_machine("M22"))):
        log = Plant(machine, np.array([0.5, 0.8, 0.5])).run(lever)
        row = log[-40]
        assert row[at.LOG_VELOCITY + 1] < -0.02
        power = row[at.PUMP : at.PUMP + 2] * row[at.DISPLACEMENT : at.DISPLACEMENT + 2]
        powers[name] = power.sum() / abs(row[at.LOG_VELOCITY + 1])
        if name == "sensing":
            share = (row[at.PUMP + 1] - row[at.ROD + 1]) / MARGIN
            assert 1.0 - pump.DROOP - 0.02 < share < 1.02
            assert np.ptp(log[-40:, at.PUMP + 1] - log[-40:, at.ROD + 1]) < 0.1 * MARGIN
    assert powers["sensing"] < 0.5 * powers["positive"]


def test_in_want_of_oil_a_compensated_block_shares_and_others_leave_the_heaviest_load():
    """Three full levers: both pumps at their end; the boom is the heaviest load."""
    first = {}
    for sharing in SHARING:
        log = Plant(sensing(sharing), np.array([0.2, 0.3, 0.3])).run(np.tile([0.95, 0.95, 0.95], (100, 1)))
        assert log[-1, at.DISPLACEMENT : at.DISPLACEMENT + 2] == pytest.approx([1.0, 1.0], abs=1e-3)
        first[sharing] = speeds(log)[-1]
    assert first["compensated"][0] > 0.05
    assert abs(first["parallel"][0]) < 0.01
    assert abs(first["pre_compensated"][0]) < 0.01


def test_a_pre_compensated_section_asks_nothing_of_the_pump_above_its_drop():
    flow, by_pump, by_load = hydraulics.section(1e-6, 200e5, 100e5, -1e9, 1e-3, COMPENSATOR)
    assert (by_pump, by_load) == (0.0, 0.0)
    assert flow == pytest.approx(1e-6 * hydraulics.orifice(COMPENSATOR)[0], rel=1e-12)
    assert hydraulics.section(1e-6, 300e5, 100e5, -1e9, 1e-3, COMPENSATOR)[0] == flow
    below = hydraulics.section(1e-6, 110e5, 100e5, -1e9, 1e-3, COMPENSATOR)
    assert below == hydraulics.section(1e-6, 110e5, 100e5, -1e9, 1e-3, 1e12)


def test_two_levers_do_not_feel_each_other_below_full_flow():
    """With compensators before the spools a second lever takes 2 % of the first one's speed, in parallel far more."""
    lost = {}
    for sharing in ("parallel", "pre_compensated"):
        alone, both = (
            speeds(Plant(sensing(sharing), np.array([0.5, 0.6, 0.6])).run(np.tile(lever, (150, 1))))[-60, 2]
            for lever in ([0.0, 0.0, -0.33], [0.33, 0.0, -0.33])
        )
        lost[sharing] = abs(both / alone - 1.0)
    assert lost["pre_compensated"] < 0.1
    assert lost["parallel"] > 2.0 * lost["pre_compensated"]


def test_at_a_stop_the_pumps_swing_back_at_the_main_relief_s_pressure():
    lever = np.tile([0.0, 0.9, 0.0], (250, 1))
    sensed, positive = (Plant(m, np.array([0.5, 0.95, 0.5])).run(lever) for m in (sensing(), load_machine("M22")))
    relief = load_machine("M22").pumps.relief
    assert sensed[-1, at.PUMP : at.PUMP + 2] == pytest.approx(relief, rel=0.01)
    assert sensed[-1, at.PUMP] < relief < positive[-1, at.PUMP]
    power = [
        (log[-1, at.PUMP : at.PUMP + 2] * log[-1, at.DISPLACEMENT : at.DISPLACEMENT + 2]).sum()
        for log in (sensed, positive)
    ]
    assert power[0] < 0.3 * power[1]


def test_the_power_limit_holds():
    """Loads that ask both pumps for all they have at 250 bar: their displacements settle where the power ends."""
    machine = sensing()
    plant = Plant(machine, np.full(3, 0.5))
    plant.state[at.HEAD : at.PUMP], plant.state[at.PUMP : at.PUMP + 2] = 248e5, 250e5
    plant.valves[:, at.SPOOL] = 0.9
    for _ in range(200):
        pump.displacement_step(plant.state, plant.valves, plant.axes, plant.plant, 0.9)
    power = machine.pumps.max_flow * 250e5 * plant.state[at.DISPLACEMENT : at.DISPLACEMENT + 2].sum()
    assert power == pytest.approx(machine.pumps.power_limit, rel=1e-6)


def test_an_unloading_valve_opens_above_the_margin_and_never_above_the_relief():
    plant = Plant(sensing(), np.full(3, 0.5)).plant
    assert hydraulics.relief_of(100e5, plant) == pytest.approx(100e5 + hydraulics.UNLOADING * MARGIN)
    assert hydraulics.relief_of(-1e9, plant) == pytest.approx(plant[at.TANK] + hydraulics.UNLOADING * MARGIN)
    assert hydraulics.relief_of(340e5, plant) == plant[at.PUMP_RELIEF]
    off = Plant(load_machine("M22"), np.full(3, 0.5)).plant
    assert hydraulics.relief_of(100e5, off) == off[at.PUMP_RELIEF]


def test_a_snapshot_holds_what_pumps_do(tmp_path):
    check_snapshot(tmp_path, text_with())


def text_with(
    pumps="load_margin = 20e5", valves="", bypass="[4.0, 20.0]", least="0.01", sharing='"compensated"'
) -> str:
    text = TEXT.replace("[pumps]\n", f"[pumps]\n{pumps}\n")
    text = text.replace("[valves]", "[valves]\n" + valves + "\n#", 1)
    for key, value in (("bypass", bypass), ("min_displacement", least), ("flow_sharing", sharing)):
        first = text.index(f"\n{key} = ") + 1
        text = text[:first] + f"{key} = {value}" + text[text.index("\n", first) :]
    return text


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bypass": "[80.0, 25.0]"}, "bypass = .* bleeds 71.6 L/min at load_margin"),
        ({"least": "0.16"}, "from 33.1 L/min"),
        ({"bypass": "[0.0, 20.0]"}, "bypass = .* bleeds 0 L/min"),
        ({"pumps": "load_margin = -1.0"}, "load_margin = -1.0"),
        ({"pumps": "load_margin = 2e7"}, "from 0 to 1e"),
        ({"pumps": "load_margin = nan"}, "load_margin = nan"),
        ({"sharing": '"pre_compensated"'}, "compensator_drop = 0.0 Pa with flow_sharing = 'pre_compensated'"),
        ({"valves": "compensator_drop = 14e5"}, "must be above 0 with 'pre_compensated'"),
        ({"valves": "compensator_drop = 25e5", "sharing": '"pre_compensated"'}, "must be at most load_margin"),
        ({"sharing": '"even"'}, "must be one of parallel, compensated, pre_compensated"),
    ],
)
def test_what_cannot_be_is_refused(changes, words):
    with pytest.raises(ConfigError, match=words):
        parse_machine(text_with(**changes), "mine.toml")


def test_a_file_with_all_of_it_is_read():
    machine = parse_machine(text_with(valves="compensator_drop = 14e5", sharing='"pre_compensated"'), "mine.toml")
    assert (machine.pumps.load_margin, machine.valves.compensator_drop) == (20e5, 14e5)
