"""Proposals for logs that nobody described: what is sure, what is said to be unsure, and what is written."""

from __future__ import annotations

import csv
import json
import os
import shlex
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edp.cli import app
from edp.cli import init as init_command
from edp.cli.console import run_app
from edp.config.twin import load_twin_experiment
from edp.data.derived_velocities import complete_velocities
from edp.data.twin_channels import twin_channels
from edp.errors import ConfigError, DataError, StorageError
from edp.logs.proposal import columns as columns_module
from edp.logs.proposal.kinds import BOUND
from edp.logs.proposal.names import unit_by_ending
from edp.logs.source import DataSource, load_signal_map
from edp.workflows.auto import load_auto
from edp.workflows.proposal import LogsProposal, propose, write_proposal
from edp.workflows.proposal.files import DATA, MAP, SETTINGS, horizons_for

pytestmark = pytest.mark.processes

Rows = dict[str, np.ndarray]


def machine(seconds: float = 30.0, rate: float = 100.0, seed: int = 0) -> Rows:
    """A cylinder: lever in %, velocity in mm/s behind it, position in mm, two pressures in bar."""
    draw = np.random.default_rng(seed)
    count = int(seconds * rate)
    lever = np.repeat(draw.uniform(-100, 100, count // 50 + 1), 50)[:count]
    speed = np.zeros(count)
    for k in range(1, count):
        speed[k] = 0.95 * speed[k - 1] + 0.05 * 4 * lever[k - 1]
    place = 600 + np.cumsum(speed) / rate
    return {
        "Zeit": np.arange(count) / rate,
        "Hebel [%]": lever,
        "v_Zyl": speed + draw.normal(0, 0.2, count),
        "Kolbenweg [mm]": place + draw.normal(0, 0.001, count),
        "Druck A [bar]": 100 + 0.2 * lever + draw.normal(0, 0.5, count),
        "pressure_b": 80 - 0.2 * lever + draw.normal(0, 0.5, count),
    }


def write(path: Path, rows: Rows, digits: int = 4) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(rows)
        writer.writerows([[f"{cell:.{digits}f}" for cell in row] for row in zip(*rows.values(), strict=True)])
    return path


def guesses(proposal: LogsProposal) -> dict[str, tuple[str, str, str]]:
    return {g.column: (g.role, str(g.kind.kind), g.kind.unit) for g in proposal.proposal.columns}


@pytest.fixture(scope="module")
def cylinder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("logs") / "run.csv", machine())


def test_names_units_ranges_and_changes_tell_columns(cylinder):
    proposal = propose(cylinder)
    assert guesses(proposal) == {
        "Zeit": ("time", "generic", "1"),
        "Hebel": ("command", "ratio", "%"),
        # No unit is stated: the change of the position in mm tells it.
        "v_Zyl": ("measured", "velocity", "mm/s"),
        "Kolbenweg": ("measured", "position", "mm"),
        "Druck A": ("measured", "pressure", "bar"),
        "pressure_b": ("measured", "pressure", "bar"),
    }
    assert proposal.targets == ("v_Zyl",)
    assert proposal.proposal.clock.rate_hz == pytest.approx(100.0)
    unit_guessed = next(g for g in proposal.proposal.columns if g.column == "pressure_b")
    assert unit_guessed.sureness == "likely"
    assert unit_guessed.check == "unit bar?"


def test_files_are_read_by_the_next_commands(cylinder, tmp_path):
    proposal = propose(cylinder)
    paths = write_proposal(proposal, tmp_path / "out")
    assert [path.name for path in paths] == [MAP, SETTINGS]
    recording = DataSource.from_path(cylinder, paths[0]).read()[0]
    assert recording.column("Kolbenweg").mean() == pytest.approx(machine()["Kolbenweg [mm]"].mean() * 1e-3, rel=1e-3)
    settings = load_auto(paths[1])
    task = settings.task.resolve(recording.rate_hz, recording.channel_names)
    assert task.targets == ("v_Zyl",)
    assert task.horizons == (1, 10)
    assert set(task.features.channels) <= set(recording.channel_names)


def test_commands_name_the_channels_of_experiments_that_stand_side_by_side(tmp_path):
    draw, columns = np.random.default_rng(3), {}
    for ending in ("Est", "Val"):
        lever = np.repeat(draw.uniform(-1.0, 1.0, 40), 25)
        level = np.convolve(lever, np.full(30, 1 / 30))[: len(lever)] + draw.normal(0.0, 0.01, len(lever))
        columns |= {f"u{ending}": lever, f"y{ending}": level}
    times = {"t": np.arange(1000) / 10.0}
    proposal = propose(write(tmp_path / "both.csv", times | dict(sorted(columns.items()))))
    write_proposal(proposal, tmp_path / "out")
    recordings = DataSource.from_path(tmp_path / "out" / DATA).read()
    assert [recording.name for recording in recordings] == ["both_est", "both_val"]
    assert proposal.inputs == ("u",)
    assert proposal.targets == ("y",)
    assert all({"u", "y"} == set(recording.channel_names) for recording in recordings)
    assert proposal.commands(tmp_path / "out")[0].endswith(" --inputs u")
    plant = shlex.split(proposal.plant_command(tmp_path / "out"))
    assert plant[:2] == ["edp", "twin"]
    assert plant[-4:] == ["--set", 'channels.commands=["u"]', "--set", 'channels.velocities=["y"]']
    settings = load_twin_experiment(None, plant[-3::2])
    channels = twin_channels(recordings[0], settings.channels)
    assert [channel.name for channel in channels.commands + channels.answers] == ["u", "y"]


def test_nothing_is_replaced_silently(cylinder, tmp_path):
    proposal = propose(cylinder)
    (tmp_path / SETTINGS).write_text("mine = 1\n")
    with pytest.raises(StorageError, match=r"settings.toml' exists already; nothing was written.*--overwrite"):
        write_proposal(proposal, tmp_path)
    assert not (tmp_path / MAP).exists()
    assert (tmp_path / SETTINGS).read_text() == "mine = 1\n"
    # A link that leads nowhere is somebody's, too.
    (tmp_path / SETTINGS).unlink()
    (tmp_path / MAP).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(StorageError, match="exists already"):
        write_proposal(proposal, tmp_path)
    write_proposal(proposal, tmp_path, overwrite=True)
    assert not (tmp_path / "elsewhere").exists()
    assert load_signal_map(tmp_path / MAP).time == "Zeit"


def test_unsure_channels_are_numbers_without_a_unit(tmp_path):
    rows = machine()
    plain = {"t": rows["Zeit"], "a": rows["Hebel [%]"], "b": rows["v_Zyl"], "Druck": rows["v_Zyl"] * 0.001}
    proposal = propose(write(tmp_path / "x.csv", plain))
    for guess in proposal.proposal.columns:
        if guess.channel:
            assert (str(guess.kind.kind), guess.kind.unit) == ("generic", "1")
            assert guess.sureness == "unsure"
            assert guess.check
    assert "# To be checked" not in proposal.files[MAP]
    assert "#   b: measured, unsure; unit unknown" in proposal.files[MAP]


@pytest.mark.parametrize(
    ("header", "values", "expected"),
    [
        ("p [bar]", "big", ("generic", "1")),  # 1e9 bar: the unit is wrong, or the number
        ("Temperatur [bar]", "usual", ("generic", "1")),  # name and unit disagree
        ("load [kN]", "usual", ("force", "kN")),
        ("x [W]", "usual", ("generic", "1")),
        ("x [t]", "usual", ("generic", "1")),  # tonnes, or time
        ("Öltemperatur", "usual", ("temperature", "degC")),
        ("Drehzahl", "thousand", ("angular_velocity", "rpm")),
        ("Kolbendruck", "pascal", ("pressure", "Pa")),
        ("Kolbendruck", "vacuum", ("generic", "1")),
    ],
)
def test_kinds(tmp_path, header, values, expected):
    count = 500
    wave = np.sin(np.arange(count) / 7)
    column = {
        "big": 1e9 * wave,
        "usual": 60 + 10 * wave,
        "thousand": 1500 + 300 * wave,
        "pascal": 1e7 + 1e6 * wave,
        "vacuum": 50 * wave,
    }[values]
    proposal = propose(write(tmp_path / "x.csv", {"t": np.arange(count) / 10, header: column}))
    assert next(iter(guesses(proposal).values()))[0] in ("time", "measured")
    assert [guess[1:] for name, guess in guesses(proposal).items() if name != "t"] == [expected]


def test_a_slow_signal_of_a_coarse_sensor_is_no_command(tmp_path):
    rows = machine(60.0)
    drift = 40 + np.linspace(0, 5, len(rows["Zeit"])) + 0.5 * np.sin(np.arange(len(rows["Zeit"])) / 900)
    rows |= {"Öltemperatur [°C]": drift.round(1), "s3": (drift * 3).round(1), "w": np.sign(rows["Hebel [%]"])}
    roles = {g.column: g.role for g in propose(write(tmp_path / "x.csv", rows)).proposal.columns}
    assert (roles["Öltemperatur"], roles["s3"], roles["w"]) == ("measured", "measured", "command")


@pytest.mark.parametrize(
    ("stamps", "unit", "rate"),
    [
        (lambda n: 10 * np.arange(n), "ms", 100.0),
        (lambda n: 1.7e12 + 10 * np.arange(n), "ms", 100.0),
        (lambda n: 1.7e9 + 0.01 * np.arange(n), "s", 100.0),
        (lambda n: 0.01 * np.arange(n), "s", 100.0),
        (lambda n: 1.0 * np.arange(n), "s", 1.0),
    ],
)
def test_units_of_time(tmp_path, stamps, unit, rate):
    rows = {"Zeit": stamps(400), "y": np.random.default_rng(0).normal(size=400).cumsum()}
    clock = propose(write(tmp_path / "x.csv", rows, digits=2)).proposal.clock
    assert (clock.column, clock.unit) == ("Zeit", unit)
    assert clock.rate_hz == pytest.approx(rate, rel=1e-3)


def test_labels_counters_and_constants_are_no_features(tmp_path):
    rows = machine(60.0)
    count = len(rows["Zeit"])
    rows |= {"Sample": np.arange(count), "fault_state": (np.arange(count) > 2000).astype(float), "gain": np.ones(count)}
    proposal = propose(write(tmp_path / "x.csv", rows))
    roles = {g.column: g.role for g in proposal.proposal.columns}
    assert (roles["Sample"], roles["fault_state"], roles["gain"]) == ("counter", "label", "constant")
    features = proposal.files[SETTINGS]
    assert not any(name in features for name in ("Sample", "fault_state", "gain"))


def test_many_logs_are_divided_by_recording_and_few_by_time(tmp_path):
    for i in range(5):
        write(tmp_path / "many" / f"{i}.csv", machine(10.0, seed=i))
        if i < 2:
            write(tmp_path / "few" / f"{i}.csv", machine(10.0, seed=i))
    assert 'kind = "names"' in propose(tmp_path / "many").files[SETTINGS]
    assert 'kind = "time"' in propose(tmp_path / "few").files[SETTINGS]


def test_a_folder_of_mixed_files(tmp_path):
    write(tmp_path / "a.csv", machine(20.0))
    write(tmp_path / "b.csv", {name: rows for name, rows in machine(10.0, seed=1).items() if name != "pressure_b"})
    write(tmp_path / "other.csv", {"t": np.arange(200) / 10, "u": np.arange(200) % 7})
    (tmp_path / "broken.mat").write_bytes(b"no MAT file")
    (tmp_path / "readme.txt").write_text("no log")
    (tmp_path / "gone.csv").symlink_to(tmp_path / "nowhere.csv")
    proposal = propose(tmp_path)
    assert [path.name for path in proposal.group.paths] == ["a.csv", "b.csv"]
    # A channel that only one log has would be refused by the next command.
    assert "pressure_b" not in {g.channel for g in proposal.proposal.columns}
    assert any("not readable" in note and "broken.mat" in note for note in proposal.notes)
    paths = write_proposal(proposal, tmp_path / "out")
    assert DATA in {path.name for path in paths}
    assert len(DataSource.from_path(tmp_path / "out" / DATA).read()) == 2


def test_repairs_that_training_needs_are_named(tmp_path):
    rows = machine(20.0)
    rows["v_Zyl"][100:110] = np.nan
    path = write(tmp_path / "x.csv", rows)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines[:900], lines[899], *lines[1300:]]) + "\n")
    proposal = propose(path)
    assert proposal.repairs == ("nan=hold", "duplicates=last", "gaps=hold")
    assert "--repair nan=hold --repair duplicates=last --repair gaps=hold" in proposal.commands(Path())[1]


def test_only_the_beginning_of_a_long_text_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(columns_module, "TEXT_BYTES", 20_000)
    path = write(tmp_path / "x.csv", machine(60.0))
    with path.open("ab") as stream:
        stream.write(b"\x00\xff no table" * 100)
    proposal = propose(path)
    assert proposal.proposal.look.rows < 1000
    assert any("looked at the first 0 of" in note for note in proposal.notes)


def test_hostile_headers(tmp_path):
    """Names that are TOML, mark-up or escape sequences stay names, or become none."""
    draw = np.random.default_rng(0)
    odd = [
        'x = "1"]\n[channels.q]',
        "[table.b]",
        "$HOME",
        'a"b\\',
        "'''",
        "# no comment",
        "\u202ered",
        "a.b.c",
        "",
        "t" * 256,
    ]
    with (tmp_path / "x.csv").open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(["time", *odd])
        writer.writerows([[f"{i / 100:.2f}", *draw.normal(size=len(odd)).round(3)] for i in range(300)])
    proposal = propose(tmp_path / "x.csv")
    paths = write_proposal(proposal, tmp_path / "out")
    signal_map = load_signal_map(paths[0])
    assert [entry.column for entry in signal_map.channels] == [g.column for g in proposal.proposal.columns if g.channel]
    assert not any("red" in entry.column for entry in signal_map.channels)
    recording = DataSource.from_path(tmp_path / "x.csv", paths[0]).read()[0]
    task = load_auto(paths[1]).task.resolve(recording.rate_hz, recording.channel_names)
    assert set(task.targets) <= set(recording.channel_names)


def test_twenty_thousand_columns_and_long_names(tmp_path):
    path = tmp_path / "x.csv"
    names = ",".join(f"c{i}" for i in range(20_000))
    row = ",".join(str(i % 97) for i in range(20_000))
    path.write_text(f"time,{names}\n" + "".join(f"{i},{row[i:]}{row[:i]}\n" for i in range(12)))
    proposal = propose(path)
    assert len(proposal.proposal.columns) == columns_module.MAX_COLUMNS
    assert any("come after the first columns" in note for note in proposal.notes)
    path.write_text(f"time,{'a' * 100_000}\n0,1\n1,2\n2,3\n")
    with pytest.raises(DataError, match=r"at most 256 are read; rename it"):
        propose(path)


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("time,a\n" + "".join(f"{i},1\n" for i in range(50)), "no column moves"),
        ("time,a\n0,1\n", "two rows or more"),
        ("time,a\n" + "".join(f"{i},on\n" for i in range(50)), "no column moves"),
        # Recordings hold single precision, in which these are infinite.
        ("time,a,b\n" + "".join(f"{i},{i % 7}e300,{-i}e305\n" for i in range(50)), "no column moves"),
    ],
)
def test_nothing_to_learn_is_one_error(tmp_path, text, why):
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(DataError, match=why):
        propose(tmp_path / "x.csv")


def test_a_plant_model_is_not_named_where_one_channel_would_command_and_answer(tmp_path):
    (tmp_path / "x.csv").write_text("time,a,b\n" + "".join(f"{i},{i // 20 * 7 % 5},\n" for i in range(400)))
    proposal = propose(tmp_path / "x.csv")
    assert (proposal.inputs, proposal.targets) == (("a",), ("a",))
    assert proposal.plant_command(tmp_path) == ""
    assert proposal.no_plant() == "no column but the command moves: record what answers it, a position or a speed"


def test_a_plant_model_of_angles_and_commands_alone_is_named_and_takes_their_changes(tmp_path):
    draw = np.random.default_rng(5)
    lever = np.repeat(draw.uniform(-1.0, 1.0, 40), 25)
    angle = np.cumsum(np.convolve(lever, np.full(30, 1 / 30))[: len(lever)]) * 0.01 + draw.normal(0.0, 1e-4, len(lever))
    columns = {"time_s": np.arange(1000) / 10.0, "joystick_boom": lever, "boom_angle_rad": angle}
    proposal = propose(write(tmp_path / "x.csv", columns))
    assert proposal.targets == ("boom_angle_rad",)
    assert proposal.no_plant() == ""
    plant = shlex.split(proposal.plant_command(tmp_path / "out"))
    assert plant[-4:] == ["--set", 'channels.commands=["joystick_boom"]', "--set", "split.kind=time"]
    write_proposal(proposal, tmp_path / "out")
    recordings = DataSource.from_path(tmp_path / "x.csv", tmp_path / "out" / MAP).read()
    completed, settings = complete_velocities(recordings, load_twin_experiment(None, plant[-3:-2]).channels)
    channels = twin_channels(completed[0], settings)
    assert [channel.name for channel in channels.answers] == ["boom_angle_rad_velocity", "boom_angle_rad"]


@pytest.mark.parametrize(
    ("name", "unit", "why"),
    [
        ("oil_temperature", "degC", "it answers with positions or speeds, and oil_temperature are none: record one"),
        ("boom_angle", "rad", "no column looks like a command: record what moves the machine"),
    ],
)
def test_where_no_plant_model_is_named_a_sentence_says_what_to_record(tmp_path, name, unit, why):
    draw = np.random.default_rng(5)
    answer = np.cumsum(draw.normal(0.0, 0.1, 1000))
    columns = {"time_s": np.arange(1000) / 10.0, f"{name}_{unit}": answer}
    if unit == "degC":
        columns["joystick_boom"] = np.repeat(draw.uniform(-1.0, 1.0, 40), 25)
    proposal = propose(write(tmp_path / "x.csv", columns))
    assert proposal.plant_command(tmp_path) == ""
    assert why in proposal.no_plant().replace(f"{name}_{unit}", name)


def test_stamps_within_messages_are_no_inputs(tmp_path):
    draw = np.random.default_rng(2)
    columns = {
        "time": np.arange(600) / 10.0,
        "arm.velocity": np.cumsum(draw.normal(0.0, 0.1, 600)),
        "transforms_1.header.stamp.sec": np.floor(np.arange(600) / 10.0 + draw.uniform(0.0, 0.3, 600)) + 1.5e9,
        "transforms_1.header.stamp.nanosec": draw.uniform(0.0, 1e9, 600),
        "stamped_force": draw.normal(size=600),
    }
    columns = propose(write(tmp_path / "x.csv", columns)).proposal.columns
    assert [guess.channel for guess in columns if guess.channel] == ["arm.velocity", "stamped_force"]
    assert [guess.why for guess in columns if guess.check == "not taken"] == ["the stamp of a message"] * 2


def test_a_data_set_file_is_no_log(tmp_path):
    (tmp_path / "d.toml").write_text("recordings = []\n")
    with pytest.raises(ConfigError, match="is a data-set file"):
        propose(tmp_path / "d.toml")


def test_horizons_by_rate():
    assert [horizons_for(rate) for rate in (1000.0, 128.0, 50.0, 10.0, 0.25, None)] == [
        (1, 100),
        (1, 13),
        (1, 5),
        (1, 5),
        (1, 5),
        (1, 5),
    ]


@pytest.fixture
def edp(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str, str]]:
    def run(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["edp", *map(str, args)])
        monkeypatch.setenv("COLUMNS", "80")
        capsys.readouterr()
        code = run_app(app)
        return code, *capsys.readouterr()

    return run


def test_command_prints_a_table_of_80_columns_and_the_next_commands(edp, cylinder, tmp_path):
    code, shown, _ = edp("init", cylinder, "--out", tmp_path, "--yes")
    assert code == 0
    table = shown.split("to predict")[0]
    assert max(map(len, table.splitlines()[1:])) <= 80
    assert f"edp train {cylinder} --map {tmp_path / MAP}" in shown
    code, _, message = edp("init", cylinder, "--out", tmp_path, "--yes")
    assert code == 1
    assert "--overwrite" in message
    code, shown, _ = edp("init", cylinder, "--out", tmp_path, "--yes", "--overwrite", "--json")
    facts = json.loads(shown)
    assert facts["targets"] == ["v_Zyl"]
    assert all(column["sure"] != "unsure" or column["confidence"] < BOUND for column in facts["columns"])


def test_command_without_a_terminal_asks_for_yes(edp, cylinder, tmp_path):
    code, _, message = edp("init", cylinder, "--out", tmp_path)
    assert code == 1
    assert "--yes" in message
    assert os.listdir(tmp_path) == []


def test_command_writes_nothing_on_a_no(edp, cylinder, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    monkeypatch.setattr("sys.stderr.isatty", lambda: True, raising=False)
    monkeypatch.setattr("typer.confirm", lambda *_, **__: False)
    code, shown, message = edp("init", cylinder, "--out", tmp_path)
    assert code == 1
    assert "nothing was written" in message
    assert "to predict: v_Zyl" in shown
    assert os.listdir(tmp_path) == []


def test_numbered_columns_that_are_taken_for_the_same_stand_in_one_row_and_no_name_is_hidden():
    long = [f"front_loader_cylinder_{side}_of_the_second_machine_beside_the_river_bank" for side in ("rod", "head")]
    names = ["p0", "p1", "p2", "p3", "q1", "q2", "r1", "s7", "s8", "s10", "x_1_a", "x_2_a", "x_3_a", "x_4_b", *long]

    def guessed(name):
        kind = SimpleNamespace(kind="pressure", unit="bar" if name != "p3" else "Pa")
        return SimpleNamespace(
            column=name, channel=name, role="measured", kind=kind, sureness="sure", check="", why="w"
        )

    shown = [row[0] for row in init_command._rows([guessed(name) for name in names])]
    assert shown[:5] == ["p0 to p2", "p3", "q1", "q2", "r1"]
    assert shown[5:10] == ["s7", "s8", "s10", "x_1_a to x_3_a", "x_4_b"]
    assert len(set(shown)) == len(shown)
    assert all(len(name) <= 60 for name in shown)


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("boom_mps", "m/s"),
        ("acc_mps2", "m/s^2"),
        ("a_m_s2", "m/s^2"),
        ("v_mm_s", "mm/s"),
        ("swing_rad_s", "rad/s"),
        ("swing_degps", "deg/s"),
        ("q_l_min", "L/min"),
        ("oil_degC", "degC"),
        ("oilTemp_degC", "degC"),
        ("f_kN", "kN"),
        ("p_kPa", "kPa"),
        ("p_A", None),
        ("x_m", None),
        ("_kN", None),
        ("CylVel_1", None),
    ],
)
def test_names_end_in_units(name, unit):
    assert unit_by_ending(name) == unit
