"""Machine files: what is refused before the first step, and files of one's own."""

import os
from importlib import resources

import pytest

from edp.errors import ConfigError
from edp.sim import Scenario, load_machine, machine_names, simulate
from edp.sim.machine.machine_files import parse_machine

TEXT = resources.files("edp.sim").joinpath("machines", "m22.toml").read_text(encoding="utf-8")


def changed(key, value, section=None):
    """M22's file with one key set to another value (text after the equals sign)."""
    lines, current = [], None
    for line in TEXT.splitlines():
        if line.startswith("["):
            current = line[1 : line.index("]")]
        here = line.split("=")[0].strip() == key and section in (None, current)
        lines.append(f"{key} = {value}" if here else line)
    assert lines != TEXT.splitlines()
    return "\n".join(lines)


BAD = [
    ("bore", "[-0.125, 0.135, 0.120]", None, ["[cylinders]", "bore[boom] = -0.125", "above 0"]),
    ("bore", "[125.0, 0.135, 0.120]", None, ["bore[boom] = 125.0", "at most 1"]),
    ("bore", '["wide", 0.135, 0.120]', None, ["cylinders.bore[boom] = 'wide'", "no number"]),
    ("bore", "[0.125, 0.135]", None, ["bore", "boom, arm, bucket"]),
    ("rod", "[0.085, 0.135, 0.080]", None, ["rod[arm] = 0.135", "below bore[arm] = 0.135"]),
    ("count", "[2, 0, 1]", None, ["count[arm] = 0", "integer from 1"]),
    ("mass", "[0.0, 950.0, 880.0]", None, ["[bodies]", "mass[boom] = 0.0", "above 0"]),
    ("gravity", "nan", None, ["gravity = nan"]),
    ("gravity", "[9.81, 9.81]", None, ["gravity = [9.81, 9.81]", "a number"]),
    ("bore", "[[0.1, 0.1], 0.135, 0.120]", None, ["cylinders.bore[boom] = [0.1, 0.1]", "a number"]),
    ("flow_sharing", '"both"', None, ["[valves]", "flow_sharing = 'both'", "compensated"]),
    ("pin_backlash", "[0.5, 0.0, 0.0]", None, ["[sensors]", "pin_backlash[boom] = 0.5", "from 0 to 0.1"]),
    ("can_latency", "[0.02, 0.01]", None, ["[sensors]", "can_latency", "smaller first"]),
    ("lift_moment", "-1.0", None, ["[chassis]", "lift_moment = -1.0", "above 0"]),
    ("gravity", "true", None, ["gravity = True", "no numbers"]),
    ("name", "22", None, ["name = 22", "text"]),
    ("name", '"a/b"', None, ["name = 'a/b'", "letters"]),
    ("volumetric_efficiency", "1.2", None, ["[pumps]", "volumetric_efficiency = 1.2", "at most 1"]),
    ("bypass", "[80.0]", None, ["pumps.bypass = [80.0]", "a list of 2 must hold"]),
    ("primary_pump", "[1, 3, 1]", None, ["primary_pump[arm] = 3", "from 1 to 2"]),
    ("static_fraction", "0.001", None, ["static_fraction = 0.001", "coulomb_fraction = 0.01"]),
    ("meter_out_extend", "[[0.0, 12.0], [150.0, 12.0], [135.0, 10.0]]", None, ["meter_out_extend[boom]", "L/min"]),
    (
        "meter_out_extend",
        "[[260.0, 12.0], 150.0, [135.0, 10.0]]",
        None,
        ["valves.meter_out_extend[arm] = 150.0", "a list"],
    ),
    ("cushion_length", "[0.8, 0.06, 0.05]", None, ["cushion_length[boom] = 0.8", "half of stroke[boom]"]),
    ("closed_length", "1.60", "boom_cylinder", ["[boom_cylinder]", "closed_length = 1.6", "1.699"]),
    ("stroke", "[1.6, 1.504, 1.104]", None, ["stroke[boom] = 1.6", "below base_radius + rod_radius = 3.269"]),
    ("stroke", "[1.48, 1.504, 1.104]", None, ["[boom_cylinder]", "lever arm", "at least 0.118"]),
    ("stroke", "[1.26, 1.504, 1.4]", None, ["[bucket_linkage]", "stroke[bucket] = 1.4", "turns over"]),
    ("link", "0.1", None, ["[bucket_linkage]", "needs pins from 1.66 to 2.764 m", "link"]),
    ("rocker", "5.0", None, ["[bucket_linkage]", "rocker = 5 m", "cannot close"]),
]


@pytest.mark.parametrize(("key", "value", "section", "said"), BAD)
def test_an_impossible_machine_is_refused_by_name(key, value, section, said):
    with pytest.raises(ConfigError) as caught:
        parse_machine(changed(key, value, section), "mine.toml")
    for part in ["mine.toml", *said]:
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TEXT + "\nwings = 2\n", "unknown key 'sensors.wings'"),
        (TEXT.replace("relief_slope", "relief_slop", 1), "did you mean 'relief_slope'"),
        (TEXT.replace("gravity = 9.81", ""), "'gravity' is missing"),
        ("oil = 3\n" + TEXT.replace("[oil]", "[spare]"), "oil: expected a table, got 3"),
        ("name = ", "not valid TOML"),
    ],
)
def test_a_damaged_file_is_refused(text, said):
    with pytest.raises(ConfigError, match=r"mine\.toml") as caught:
        parse_machine(text, "mine.toml")
    assert said in str(caught.value)


def test_a_third_machine_is_a_file_only(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TEXT.replace('"M22"', '"Mine"'))
    assert load_machine(str(path)).name == "Mine"
    recording = simulate(Scenario(machine=str(path), duration_s=1.0))
    assert recording.source == "sim:Mine"
    assert "/" not in recording.name
    path.write_text(TEXT.replace('"M22"', '"Mine2"') + "# longer")
    os.utime(path, ns=(1, 1))
    assert load_machine(str(path)).name == "Mine2"


def test_unknown_machines_and_files(tmp_path):
    assert {"C14", "M22"} <= set(machine_names())
    with pytest.raises(ConfigError, match="did you mean 'M22'"):
        load_machine("M23")
    with pytest.raises(ConfigError, match=r"none\.toml cannot be read.*M22"):
        load_machine("none.toml")
    folder = tmp_path / "folder.toml"
    folder.mkdir()
    with pytest.raises(ConfigError, match="cannot be read"):
        load_machine(str(folder))
