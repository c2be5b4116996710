"""More forms of logs of other people's machines and loggers: each made here from synthetic numbers."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import Repair, read_recording, write_recording
from edp.logs.formats.base import RawLog, RawSignal
from edp.logs.formats.csv_dates import dates_of
from edp.logs.proposal import columns as looked
from edp.logs.proposal.behaviour import is_steered_by
from edp.logs.proposal.columns import LogColumn
from edp.logs.proposal.names import kind_by_word, role_by_word
from edp.recording import Recording
from edp.signals import Channel, ChannelMap, Kind, SignalMap
from edp.workflows.proposal import LogsProposal, propose

pytestmark = pytest.mark.processes

COUNT = 1500
TIME = np.arange(COUNT) / 100
SWING = np.sin(np.arange(COUNT) / 30) + 0.2 * np.sin(np.arange(COUNT) / 7)
OTHER = np.cos(np.arange(COUNT) / 23)


def table(path: Path, columns: dict[str, np.ndarray], head: bool = True) -> Path:
    cells = [[value if isinstance(value, str) else f"{value:.6g}" for value in values] for values in columns.values()]
    lines = [",".join(columns)] if head else []
    path.write_text("\n".join([*lines, *(",".join(row) for row in zip(*cells))]) + "\n")
    return path


def roles(found: LogsProposal) -> dict[str, str]:
    return {guess.column: guess.role for guess in found.proposal.columns}


def test_a_measured_velocity_is_no_answer_of_a_controller(tmp_path):
    """A controller's answer is what it makes of a deviation; a velocity is what the position does."""
    reference = np.repeat(SWING[::50], 50)
    position, velocity, answer = np.zeros((3, COUNT))
    for k in range(COUNT - 1):
        answer[k] = 20 * (reference[k] - position[k]) - 0.1 * velocity[k]
        velocity[k + 1] = velocity[k] + 0.15 * (answer[k] - velocity[k])
        position[k + 1] = position[k] + 0.01 * velocity[k + 1]
    columns = {"time": TIME, "posd1": reference, "posa1": position, "vela1": velocity}
    columns |= {"err1": reference - position, "k": answer}
    asked, moved, rate, made = (LogColumn(name, (columns[name],), COUNT) for name in ("posd1", "posa1", "vela1", "k"))
    assert is_steered_by(made, asked, moved)
    assert not is_steered_by(rate, asked, moved)
    found = propose(table(tmp_path / "arm.csv", columns))
    named = {name: role for name, role in roles(found).items() if name != "k"}
    assert named == {"time": "time", "posd1": "reference", "posa1": "measured", "vela1": "measured", "err1": "measured"}
    assert found.targets == ("vela1",)


@pytest.mark.parametrize(
    ("name", "role", "kind"),
    [
        ("Arm_OutR_Cyl_P", "", Kind.PRESSURE),
        ("gain_P", "", None),
        ("Boom_ang", "", Kind.ANGLE),
        ("ang_vel_2", "", Kind.ANGULAR_VELOCITY),
        ("veld3.txt", "reference", Kind.VELOCITY),
        ("u1", "command", None),
        ("r", "reference", None),
        ("wheel_r", "", None),
    ],
)
def test_what_names_say(name, role, kind):
    assert (role_by_word(name), kind_by_word(name)) == (role, kind)


def test_the_unit_of_a_column_follows_from_all_logs_and_from_its_row_of_axes(tmp_path):
    rest, work = np.full(COUNT, 0.3), 40 + 30 * SWING
    for i, name in enumerate(("a", "b", "c")):
        columns = {"time": TIME, "Boom_pressure": work if i == 2 else rest + 0.01 * OTHER}
        columns |= {"speed1": 0.5 * SWING, "speed2": 0.001 * OTHER}
        table(tmp_path / f"{name}.csv", columns)
    units = {guess.column: guess.kind.unit for guess in propose(tmp_path).proposal.columns}
    assert units["Boom_pressure"] == "bar"
    assert units["speed2"] == units["speed1"] == "m/s"


def test_every_log_of_a_folder_is_compared_by_its_columns(tmp_path):
    """Of many logs twelve are looked at: a list of results among the others would refuse the training."""
    for i in range(30):
        table(tmp_path / f"log{i:02d}.csv", {"time": TIME[:50], "u": SWING[:50], "y": OTHER[:50] + i})
    table(tmp_path / "log11_result.csv", {"gain": np.arange(5.0), "delay": np.arange(5.0)})
    found = propose(tmp_path)
    assert len(found.group.paths) == 30
    assert "log11_result.csv" not in found.files["data.toml"]
    assert any("has other columns than the logs that were looked at" in note for note in found.notes), found.notes


def test_frames_of_a_bus_are_refused_though_their_numbers_move(tmp_path):
    frames = np.array(["4D 74 30 04"] * COUNT)
    columns = {"time": TIME, "pgn": 60000 + np.arange(COUNT) % 7, "source": np.arange(COUNT) % 5, "data": frames}
    with pytest.raises(DataError, match="raw frames of a bus"):
        propose(table(tmp_path / "can.csv", columns))


def test_names_that_run_into_the_first_row(tmp_path):
    path = table(tmp_path / "motor.csv", {"step": np.arange(COUNT) + 1.0, "time": TIME, "speed": SWING})
    names, rest = path.read_text().split("\n", 1)
    path.write_text(f"{names},{rest}")
    made = read_recording(path, SignalMap(others=True))
    assert made.channel_names == ("step", "speed")
    assert made.samples == COUNT - 1


def test_a_clock_behind_numbers_of_rows(tmp_path):
    columns = {"a": np.arange(COUNT) + 1.0, "b": TIME + 0.02, "c": SWING, "d": OTHER}
    clock = propose(table(tmp_path / "log.csv", columns, head=False)).proposal.clock
    assert clock.column == "column_2"
    assert clock.rate_hz == pytest.approx(100.0)


def test_dates_before_numbers_without_names(tmp_path):
    stamps = np.array([f"2015/3/9 10:{k // 100:02d}:{k % 100 * 0.6:06.3f}" for k in range(COUNT)])
    path = table(tmp_path / "log.csv", {"t": stamps, "a": SWING, "b": OTHER}, head=False)
    found = propose(path)
    assert found.proposal.clock.column == "column_1"
    made = read_recording(path, found.proposal.signal_map)
    assert (made.samples, made.rate_hz) == (COUNT, pytest.approx(1 / 0.6))


@pytest.mark.parametrize(
    ("text", "date"),
    [
        ("2015/3/9 10:56:05.5", "2015-03-09T10:56:05.5"),
        ("2015.03.09", "2015-03-09"),
        ("2015-3-9T7:05", "2015-03-09T07:05"),
    ],
)
def test_dates_with_the_year_first(text, date):
    assert dates_of([text])[0] == np.datetime64(date, "ns")


@pytest.mark.parametrize("text", ["2015/13/09", "2015/3/9 25:00:00", "2015/3/x"])
def test_what_is_no_date_is_refused(text):
    with pytest.raises(ValueError, match=r"time|pars|range|month|hour"):
        dates_of([text])


def test_numbers_with_prefixes_and_units_within_names(tmp_path):
    current = np.array([f"{value:.1f}m" if i % 3 else "25" for i, value in enumerate(20 * SWING)])
    path = table(tmp_path / "stand.csv", {"Current (mA) - Plot 0": current, "Flow (GPM) - Plot 0": 2 + SWING})
    made = read_recording(path, SignalMap(others=True, sample_time_s=0.01))
    assert made.values[1, 0] == pytest.approx(float(current[1][:-1]) * 1e-3 * 1e-3, rel=1e-5)
    assert made.values[0, 1] == pytest.approx(2 * 3.785411784e-3 / 60, rel=1e-5)
    with pytest.raises(DataError, match="holds text '7x' in line"):
        read_recording(
            table(tmp_path / "bad.csv", {"a": np.array(["7m", "7x"]), "b": SWING[:2]}),
            SignalMap((ChannelMap("a", "a", "1", Kind.GENERIC),), sample_time_s=0.01),
        )


def test_a_matrix_of_cycles_is_said_to_be_none_of_channels(tmp_path):
    level = np.cumsum(np.random.default_rng(0).normal(size=(200, 1)), axis=0)
    matrix = level + 0.01 * np.arange(40) ** 1.5
    columns = {str(i): matrix[:, i] for i in range(40)}
    notes = propose(table(tmp_path / "TS1.txt", columns, head=False)).notes
    assert any("a row seems to hold samples of one signal" in note for note in notes)


@pytest.mark.parametrize(("hz", "told"), [(5.0, False), (40.0, True)])
def test_motion_that_a_lower_rate_loses_is_named(tmp_path, hz, told):
    time = np.arange(16_000) / 1000
    columns = {"time": time, "speed": np.sin(2 * np.pi * hz * time) + 0.1 * np.sin(2 * np.pi * time), "u": np.sin(time)}
    found = propose(table(tmp_path / "fast.csv", columns))
    assert found.proposal.signal_map.rate_hz == 100.0
    notes = [note for note in found.notes if "of the motion of speed is faster than" in note]
    assert bool(notes) == told
    assert not told or "set rate_hz = 200" in notes[0]


def test_tables_of_text_beside_other_logs_are_named(tmp_path):
    table(tmp_path / "log.csv", {"time": TIME, "u": SWING, "y": OTHER})
    (tmp_path / "README.txt").write_text("These logs, of a rig,\nare of May.\n\nAsk us, please.\n")
    assert not any("text files beside" in note for note in propose(tmp_path).notes)
    table(tmp_path / "stand.txt", {"a": SWING[:20], "b": OTHER[:20]})
    assert any("not looked at: stand.txt; give" in note for note in propose(tmp_path).notes)


def test_a_clock_that_stands_still_is_named(tmp_path):
    found = propose(table(tmp_path / "log.csv", {"time": 0 * TIME, "u": SWING, "y": OTHER}))
    assert "'time' stands still: a row counts as 1 s" in found.proposal.clock.check
    assert found.proposal.signal_map.sample_time_s == 1.0
    names = {"time": 0 * TIME, "CylVels_1": SWING}
    with pytest.raises(DataError, match="no time stamp is later than the first"):
        read_recording(table(tmp_path / "still.csv", names))


def test_a_start_without_values_is_left_out_where_missing_values_are_held(tmp_path):
    late, gap = SWING.astype(str), OTHER.astype(str)
    late[: 5000 // 40] = ""
    gap[700] = ""
    path = table(tmp_path / "log.csv", {"time": TIME, "u": late, "y": gap})
    found = propose(path)
    assert found.repairs == ("nan=hold",)
    made = read_recording(path, found.proposal.signal_map, repair=Repair(nan="hold"))
    assert made.samples == COUNT - 125
    assert {"repair": "nan = hold: start left out", "channel": "u", "count": 125, "row": 0} in made.meta["repairs"]
    late[: COUNT - 100] = ""
    table(path, {"time": TIME, "u": late, "y": gap})
    with pytest.raises(DataError, match=r"'u' has its first number in row 1400 of 1,500; leave it out"):
        read_recording(path, found.proposal.signal_map, repair=Repair(nan="hold"))


def test_bursts_of_a_logger_do_not_set_the_pace_of_a_bag(tmp_path):
    bursts = np.sort(np.concatenate([start + np.arange(10) * 1e-4 for start in np.linspace(0, 14.9, 12)]))
    signals = {
        "/rosout.level": RawSignal("/rosout.level", lambda: np.arange(120.0) % 3, 120, bursts),
        "/status.code": RawSignal("/status.code", lambda: np.arange(120.0) % 4, 120, bursts),
        "/joint.position": RawSignal("/joint.position", lambda: SWING, COUNT, TIME),
    }
    raw = RawLog(tmp_path / "a.bag", signals)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(looked, "open_log", lambda path, signal_map: raw)
        look = looked._look_at_signals(raw.path, raw.path, "", SignalMap(others=True))
    assert look is not None
    assert look.rows == COUNT
    assert look.step_s == pytest.approx(0.01)
    assert "/rosout.level" not in look.names


def test_a_recording_of_edp_starts_where_it_did(tmp_path):
    made = Recording("a", (Channel("CylVels_1", Kind.VELOCITY),), np.float32(SWING[:, None]), 100.0)
    write_recording(made, tmp_path / "a.csv")
    assert read_recording(tmp_path / "a.csv", repair=Repair(nan="hold")).samples == COUNT
