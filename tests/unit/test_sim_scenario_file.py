"""Data sets described in one file."""

from importlib import resources
from pathlib import Path

import pytest

import edp.sim.data_set
from edp.errors import ConfigError, StorageError
from edp.jobs import IN_PROCESS
from edp.sim import DEFAULT_MIX, DataSetSpec, Scenario, plan_data_set, read_scenario_file, simulate_many
from edp.sim.data_set import SimulationOrder, bytes_needed, simulate_data_set
from edp.sim.predictability import LimitSpec
from edp.sim.scenario import scenario_to_dict
from edp.sim.scenario_file import limit_settings

EXAMPLES = sorted((Path(__file__).parents[2] / "examples" / "scenarios").glob("*.toml"))


def written(tmp_path, text):
    path = tmp_path / "set.toml"
    path.write_text(text)
    return path


@pytest.mark.long
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_examples_are_valid(path):
    order = SimulationOrder.from_scenario(path)
    plan = order.scenarios()
    assert len(plan) == order.recordings
    assert {s.excitation for s in plan} == {name for name, share in order.mix.items() if share > 0}


def test_the_default_example_is_the_default():
    default = next(path for path in EXAMPLES if path.stem == "m22")
    assert SimulationOrder.from_scenario(default) == SimulationOrder()
    assert SimulationOrder().mix == DEFAULT_MIX


def test_every_key_arrives_and_options_go_first(tmp_path):
    path = written(
        tmp_path,
        """
        machine = "C14"
        minutes = 4
        recordings = 8
        seed = 3
        rate_hz = 200.0
        step_s = 0.0005
        start_strokes = [0.4, 0.6]
        sensor_noise = true
        [mix]
        dig = 3
        isolated = 1
        [materials]
        air = 1
        clay = 2
        [sensors]
        can_loss = 0.01
        can_latency = [0.002, 0.004]
        [files]
        format = "mat"
        layout = "simulink"
        """,
    )
    order = SimulationOrder.from_scenario(path, minutes=6.0, seed=None)
    assert (order.minutes, order.seed, order.suffix, order.layout) == (6.0, 3, ".mat", "simulink")
    plan = order.scenarios()
    assert [s.excitation for s in plan].count("dig") == 6
    assert sorted(s.material for s in plan if s.excitation == "dig") == ["", "", *["clay"] * 4]
    assert all(not s.material for s in plan if s.excitation == "isolated")
    first = plan[0]
    assert (first.rate_hz, first.step_s, first.start_strokes, first.duration_s) == (200.0, 0.0005, (0.4, 0.6), 45.0)
    assert first.load().sensors.can_loss == 0.01
    assert Scenario(**scenario_to_dict(first)) == first
    assert {s.name for s in plan if s.material} <= {f"c14_{i:03d}_dig_clay" for i in range(8)}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("minutes = ", "not valid TOML"),
        ("minuts = 5", "unknown key 'minuts'; did you mean 'minutes'"),
        ("minutes = -1", "minutes = -1.0; 0.0001 <= minutes <= 1,000,000 must hold"),
        ("minutes = nan", "minutes = nan: a finite number must hold"),
        ("recordings = 2.5", "recordings = 2.5: an integer must hold"),
        ("seed = true", "seed = True: true and false are no numbers"),
        ("seed = -1", "seed = -1; integers, 0 <= seed"),
        ("rate_hz = 2000", "rate_hz = 2000.0; 1 <= rate_hz <= 1,000 must hold"),
        ("step_s = 0.01", "step_s = 0.01; 0 < step_s <= 0.0025 must hold"),
        ("step_s = 0.0003", "does not divide the sample time"),
        ("machine = 'C15'", "unknown machine 'C15'; did you mean 'C14'"),
        ("machine = 'absent.toml'", "absent.toml cannot be read"),
        ("machine = 4", "machine = 4: a text in quotes must hold"),
        ("[mix]\ndigg = 1", "unknown excitation 'digg'; did you mean 'dig'"),
        ("[mix]\ndig = -0.5", "mix: share -0.5 of 'dig' must not be negative"),
        ("[mix]\ndig = 'much'", "mix.dig = 'much': a text is no number"),
        ("[mix]\ndig = 0", "mix: the shares add up to nothing"),
        ("mix = 3", "mix = 3: a table must hold"),
        ("[materials]\nsandy_lome = 1", "unknown material 'sandy_lome'; did you mean 'sandy_loam'"),
        ("[mix]\nisolated = 1\n[materials]\nclay = 1", "no family of mix works the ground"),
        (
            "[sensors]\ncan_los = 0.1",
            "with the scenario's sensors: .*\n.*unknown key 'can_los'; did you mean 'can_loss'",
        ),
        ("[sensors]\ncan_loss = 2.0", "can_loss = 2.0"),
        ("start_strokes = [0.9]", "start_strokes = .0.9. lists 1; a list of 2 must hold"),
        ("start_strokes = [0.9, 0.1]", "0 <= low <= high <= 1"),
        ("family = 2\nmasses = [30, 10]", "family of machines from 30.0 to 10.0 t; the lower must not exceed"),
        ("family = 2\nmasses = 10", "masses = 10: a list must hold"),
        ("masses = [10, 20]", "are those of a family; say how many machines with family"),
        ("sensor_noise = 1", "sensor_noise = 1: write true or false"),
        ("[files]\nformat = 'parket'", "no log format for the ending '.parket'; did you mean '.parquet'"),
        ("[files]\nlayot = 'x'", "unknown key 'files.layot'; did you mean 'layout'"),
        ("[files]\nlayout = 'simulnk'\nformat = 'mat'", "did you mean 'simulink'"),
        ("[files]\nformat = 3", "files.format = 3: a text in quotes must hold"),
    ],
)
def test_bad_files_are_refused_with_file_key_value_and_bound(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        SimulationOrder.from_scenario(written(tmp_path, text))
    assert "set.toml" in str(caught.value)


SOIL = """
machine = "C14"
minutes = 1
recordings = 4
seed = 3
[mix]
dig = 1
grading = 1
[materials]
clay = 1
[files]
format = "mat"
layout = "speedgoat"
truth = "apart"
"""


def test_another_format_leaves_out_the_layout_of_the_file_and_says_so(tmp_path):
    path, notes = written(tmp_path, SOIL), []
    order = SimulationOrder.from_scenario(path, notes.append, suffix=".parquet")
    assert (order.suffix, order.layout, order.truth) == (".parquet", "", "apart")
    assert len(notes) == 1
    assert "layout 'speedgoat' is one of MAT files, and format parquet was asked for" in notes[0]
    assert SimulationOrder.from_scenario(path, notes.append, suffix=".mat").layout == "speedgoat"
    assert len(notes) == 1
    with pytest.raises(ConfigError, match=r"layout 'simulink' is one of MAT files, not of '.parquet'; ask for mat"):
        SimulationOrder.from_scenario(path, suffix=".parquet", layout="simulink")


@pytest.mark.processes
def test_a_family_takes_the_place_of_the_file_s_machine_and_the_rest_stays(tmp_path):
    order = SimulationOrder.from_scenario(written(tmp_path, SOIL), family=2, masses=(12.0, 20.0))
    plan = order.scenarios()
    assert {s.machine for s in plan} == {"family-3-0-12-20", "family-3-1-12-20"}
    assert {s.excitation for s in plan} == {"dig", "grading"}
    assert {s.material for s in plan} == {"clay"}
    for kind in ("dig", "grading"):
        assert len({s.machine for s in plan if s.excitation == kind}) == 2
    assert len({s.name for s in plan}) == 4
    alone, together = (list(simulate_many(plan[:2], workers)) for workers in (1, 2))
    assert [r.digest for r in alone] == [r.digest for r in together]


def test_a_machine_takes_the_place_of_the_file_s_family(tmp_path):
    path, notes = written(tmp_path, "family = 3\nmasses = [10, 20]"), []
    assert SimulationOrder.from_scenario(path).masses == (10.0, 20.0)
    order = SimulationOrder.from_scenario(path, notes.append, machine="C14")
    assert (order.family, order.machine) == (0, "C14")
    assert "family of 3 machines, and machine C14 was asked for" in notes[0]
    assert SimulationOrder.from_scenario(path, family=0).scenarios()[0].machine == "M22"
    with pytest.raises(ConfigError, match="machine = C14 and family = 2: a family takes the machine's place"):
        SimulationOrder.from_scenario(machine="C14", family=2)


def test_soils_of_the_command_line_take_the_place_of_the_file_s(tmp_path):
    own = tmp_path / "peat.toml"
    known = resources.files("edp.sim").joinpath("materials").joinpath("clay.toml").read_text()
    own.write_text(known.replace('name = "clay"', 'name = "peat"'))
    order = SimulationOrder.from_scenario(written(tmp_path, SOIL), materials={str(own): 1.0, "air": 1.0})
    assert {s.material for s in order.scenarios()} == {str(own), ""}
    plan = plan_data_set("M22", 1.0, 2, seed=0, mix={"dig": 1}, materials={"gravel": 1})
    assert {s.material for s in plan} == {"gravel"}


def test_an_absent_file_is_refused(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_scenario_file(tmp_path / "absent.toml")


def test_a_data_set_longer_than_the_disk_is_refused_before_the_first_step(tmp_path, monkeypatch):
    order = SimulationOrder.from_scenario(minutes=1e6, recordings=50)
    monkeypatch.setattr(edp.sim.data_set.shutil, "disk_usage", lambda folder: type("Usage", (), {"free": 10**9}))
    with pytest.raises(StorageError, match=r"minutes: 1e\+06 min as .parquet need about .* GB free; simulate at most"):
        simulate_data_set(tmp_path / "set", order)
    assert list((tmp_path / "set").iterdir()) == []


def test_room_is_estimated_from_above(tmp_path):
    order = SimulationOrder.from_scenario(minutes=0.5, recordings=1, suffix=".csv")
    (path,) = simulate_data_set(tmp_path, order, workers=IN_PROCESS)
    assert 0.5 < path.stat().st_size / bytes_needed(order.scenarios(), ".csv") < 1.0


@pytest.mark.processes
@pytest.mark.parametrize("material", ["", "sandy_loam"])
def test_closed_loops_give_the_same_bits_for_any_number_of_workers(material):
    materials = {material: 1.0} if material else {}
    spec = DataSetSpec(minutes=0.4, recordings=3, seed=5, mix={"grading": 1, "dig": 2}, materials=materials)
    plan = spec.scenarios()
    alone, together = (list(simulate_many(plan, workers)) for workers in (1, 3))
    assert [r.digest for r in alone] == [r.digest for r in together]
    assert len({r.digest for r in alone}) == 3
    assert [r.meta["material"] for r in together] == [material] * 3


def test_the_limit_and_single_keys_can_be_changed(tmp_path):
    path = written(tmp_path, 'machine = "C14"\nrecordings = 8\n[limit]\nmoments = 60\nhorizons = [1, 10]\n')
    assert limit_settings(path, ["limit.branches=8"]) == LimitSpec(horizons=(1, 10), moments=60, branches=8)
    assert limit_settings(None, ()) == LimitSpec()
    order = SimulationOrder.from_scenario(
        path, None, ["family=3", "masses=[12,20]", "files.layout=speedgoat", "files.format=mat"]
    )
    assert (order.family, order.masses, order.layout, order.suffix) == (3, (12.0, 20.0), "speedgoat", ".mat")
    # What the command line asks for by an option goes before single keys.
    assert SimulationOrder.from_scenario(path, None, ["minutes=7", "recordings=2"], minutes=5.0).minutes == 5.0
    with pytest.raises(ConfigError, match="unknown key 'recording'; did you mean 'recordings'"):
        SimulationOrder.from_scenario(path, None, ["recording=3"])
    with pytest.raises(ConfigError, match="branches = 5 must be even"):
        limit_settings(path, ["limit.branches=5"])
