"""Text logs whose columns blanks part, tables of messages, and ``.dat`` files."""

from __future__ import annotations

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import read_recording
from edp.logs.proposal.columns import look_at_log
from edp.logs.read import find_recordings
from edp.signals import SignalMap
from edp.workflows.proposal import propose

pytestmark = pytest.mark.processes

ALL = SignalMap(others=True)


def test_columns_parted_by_any_number_of_blanks(tmp_path):
    path = tmp_path / "arm.dat"
    path.write_text("# t x y\n" + "".join(f"  {0.01 * i:.2f}   {i}  -{i}.5 \n" for i in range(60)))
    read = read_recording(path, ALL)
    assert read.rate_hz == 100.0
    assert read.channel_names == ("x", "y")
    assert list(read.column("y")[:3]) == [-0.5, -1.5, -2.5]
    assert read.samples == 60


def test_blanks_part_no_table_of_words_or_of_one_column(tmp_path):
    (tmp_path / "a.txt").write_text("one two\nthree four\n" * 5)
    with pytest.raises(DataError):
        read_recording(tmp_path / "a.txt", ALL)


def test_dat_files_are_logs_where_they_hold_text_and_no_others_are_there(tmp_path):
    (tmp_path / "inca.dat").write_bytes(b"MDF     3.30    INCA\0\0" + bytes(200))
    with pytest.raises(DataError, match=r"1 end in '\.dat': save it as MDF 4"):
        find_recordings(tmp_path)
    with pytest.raises(DataError, match=r"named \.dat but holds .*; save it as MDF 4"):
        read_recording(tmp_path / "inca.dat", ALL)
    (tmp_path / "b.dat").write_text("t\tx\n0\t1\n")
    assert [path.name for path in find_recordings(tmp_path)] == ["b.dat"]
    (tmp_path / "c.csv").write_text("t,x\n0,1\n")
    assert [path.name for path in find_recordings(tmp_path)] == ["c.csv"]


def messages(rows: int = 400) -> str:
    """Two topics at 30 Hz and one at 10 Hz, a message a row."""
    lines = ["__time,/boom/position,/boom/lever,/oil/temperature"]
    for i in range(rows):
        lines += [f"{100 + i / 30:.6f},{500 + 300 * np.sin(i / 9):.4f},,"]
        lines += [f"{100.004 + i / 30:.6f},,{np.sin(i / 7 // 1):.4f},"]
        lines += [f"{100.009 + i / 30:.6f},,,{40 + i / 100:.3f}"] if i % 3 == 0 else []
    return "\n".join(lines) + "\n"


def test_a_table_of_messages_has_times_of_its_own_a_column(tmp_path):
    path = tmp_path / "plot.csv"
    path.write_text(messages())
    read = read_recording(path, ALL)
    assert read.rate_hz == pytest.approx(30.0, rel=1e-3)
    assert np.isfinite(read.values).all()
    look = look_at_log(path)
    assert look.step_s == pytest.approx(1 / 30, rel=1e-3)
    proposal = propose(path)
    assert proposal.repairs == ()
    assert proposal.targets == ("boom/position",)
    assert "boom/lever" in [guess.channel for guess in proposal.proposal.select_role("command")]


def test_empty_cells_of_a_usual_table_stay_missing_values(tmp_path):
    path = tmp_path / "a.csv"
    rows = [f"{0.01 * i:.2f},{i},{'' if i % 10 else i},{'' if i % 3 else i}" for i in range(100)]
    path.write_text("time,a,b,c\n" + "\n".join(rows) + "\n")
    with pytest.raises(DataError, match="90 missing or infinite"):
        read_recording(path, ALL)


def test_logs_that_repeat_another_one_byte_for_byte_are_left_out(tmp_path):
    noise = np.random.default_rng(0).normal(size=(4, 300, 2)).cumsum(axis=1)
    for name, walk in zip("abcd", noise):
        rows = [f"{0.01 * i:.2f},{x:.3f},{y:.3f}" for i, (x, y) in enumerate(walk)]
        (tmp_path / f"{name}.csv").write_text("time,speed,lever\n" + "\n".join(rows) + "\n")
    (tmp_path / "e.csv").write_bytes((tmp_path / "b.csv").read_bytes())
    proposal = propose(tmp_path)
    assert [path.name for path in proposal.group.paths] == ["a.csv", "b.csv", "c.csv", "d.csv"]
    assert any("byte for byte: e.csv (as b.csv)" in note for note in proposal.notes)
    assert "e.csv" not in proposal.files["data.toml"]


def test_inches_and_pounds_force_are_units(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time (s),stroke (in),force (kip)\n" + "".join(f"{i / 100},{i % 7},{i % 5}\n" for i in range(50)))
    columns = {guess.column: guess.kind for guess in propose(path).proposal.columns}
    assert (columns["stroke"].kind, columns["stroke"].unit) == ("position", "in")
    assert (columns["force"].kind, columns["force"].unit) == ("force", "kip")


def test_states_of_switches_are_numbers(tmp_path):
    path = tmp_path / "a.csv"
    rows = [
        f"{i / 100:.2f},{i},{'ON' if i % 3 else 'off'},{'true' if i > 9 else ''},{'dig' if i % 2 else 'on'}"
        for i in range(60)
    ]
    path.write_text("time,x,pump,valve,mode\n" + "\n".join(rows) + "\n")
    columns = {column.name: column for column in look_at_log(path).columns}
    assert list(columns["pump"].values[:4]) == [0.0, 1.0, 1.0, 0.0]
    assert np.isnan(columns["valve"].values[0])
    assert columns["valve"].values[10] == 1.0
    assert "mode" not in columns


def test_columns_of_one_name_are_told_apart(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("time,lever,speed,speed\n" + "".join(f"{i / 100},{i % 5},{i},{2 * i}\n" for i in range(60)))
    read = read_recording(path, ALL)
    assert read.channel_names == ("lever", "column_3.speed", "column_4.speed")
    assert read.column("column_4.speed")[3] == 6.0


def test_raw_frames_of_a_bus_say_that_they_are_to_be_decoded(tmp_path):
    path = tmp_path / "trace.csv"
    path.write_text("Time,ID,DLC,Data\n" + "".join(f"{i / 100},0x1{i % 9},8,00 {i % 10}F\n" for i in range(60)))
    with pytest.raises(DataError, match=r"raw frames of a bus .*DBC"):
        propose(path)
    (tmp_path / "trace.csv").unlink()
    (tmp_path / "a.blf").write_bytes(b"LOGG")
    with pytest.raises(DataError, match=r"1 end in '\.blf': it holds frames of a bus"):
        find_recordings(tmp_path)


def test_a_log_whose_end_rests_however_it_is_divided_is_said(tmp_path):
    path = tmp_path / "a.csv"
    steps = np.r_[np.sin(np.arange(400) / 20), np.zeros(5600)]
    rows = [f"{i / 100:.2f},{x:.4f},{y:.4f}" for i, (x, y) in enumerate(zip(steps, np.cumsum(steps)))]
    path.write_text("time,lever,speed\n" + "\n".join(rows) + "\n")
    assert any("a test there says little" in note for note in propose(path).notes)
