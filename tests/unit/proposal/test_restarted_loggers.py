"""Logs of loggers that were restarted, lost rows or power, as machines leave them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import Repair, read_recording
from edp.logs.formats import csv_leftovers
from edp.logs.source import DataSource
from edp.signals import SignalMap
from edp.workflows.proposal import propose

pytestmark = pytest.mark.processes

NAMES = "t,x1,y1,s_boom,s_arm,v_boom,v_arm"
WHOLE = SignalMap(others=True, time="t", time_unit="ms")


def rows(count: int, start_ms: int = 0, seed: int = 0, arm: bool = False) -> list[str]:
    """A lever moved by hand in steps, the stroke that follows it and its speed, at 100 ms with lost rows."""
    rng = np.random.default_rng(seed)
    stamps = start_ms + 100 * np.cumsum(rng.choice([1, 1, 1, 2], count))
    lever = np.repeat(rng.integers(-9, 10, count // 20 + 1) / 10, 20)[:count]
    speed = np.convolve(60 * lever, np.full(3, 1 / 3))[:count]
    stroke = 100 + np.cumsum(speed) * 0.125 + 0.01 * rng.standard_normal(count)
    still = np.zeros(count)
    columns = [stamps, still, lever, still, stroke, still, speed] if arm else None
    columns = columns or [stamps, lever, still, stroke, still, speed, still]
    return [",".join(f"{value:.2f}" for value in row) for row in np.stack(columns, axis=1)]


def save(path: Path, lines: list[str], end: bytes = b"") -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_bytes("".join(f"{line}\r\n" for line in lines).encode() + end)
    return path


@pytest.mark.parametrize("place", [40, 700])
def test_names_that_a_restarted_logger_wrote_anew_are_left_out(tmp_path, place):
    path = save(tmp_path / "a.csv", [NAMES, *rows(place, 30_000), f"{NAMES} ", *rows(900, seed=1)])
    with pytest.raises(DataError, match=rf"time goes back in 1 row\(s\), first in row {place} .*falling=cut"):
        read_recording(path, WHOLE)
    made = read_recording(path, WHOLE, repair=Repair(falling="cut"))
    last = save(tmp_path / "b.csv", [NAMES, *rows(900, seed=1)])
    np.testing.assert_array_equal(made.values, read_recording(last, WHOLE).values)
    quality = DataSource(path, signal_map=WHOLE).inspect()
    told = [finding for report in quality.reports for finding in report.findings if "names stand again" in finding.what]
    assert [finding.where for finding in told] == [f"line {place + 2}"]


def test_line_numbers_stay_those_of_the_file(tmp_path):
    body = rows(600)
    path = save(tmp_path / "a.csv", [NAMES, *body[:300], NAMES, *body[300:400], "7,8", *body[400:]])
    with pytest.raises(DataError, match="line 403 has 2 cells, the header has 7"):
        read_recording(path, WHOLE)


@pytest.mark.parametrize(
    ("behind", "end"),
    [
        (["host_time,raw_line"], b"1785826239.0,  \x06\x1e\x00\r\n"),
        (["End of test"], b""),
        ([], b"\x00\x00106307,0.0,0.0,1\x13,2,3,4\r\n"),
        (["-- power off --", "", ""], b""),
    ],
)
def test_what_stands_behind_the_table_is_left_out_and_told(tmp_path, behind, end):
    path = save(tmp_path / "a.csv", [NAMES, *rows(600), *behind], end)
    assert (
        read_recording(path, WHOLE).samples
        == read_recording(save(tmp_path / "b.csv", [NAMES, *rows(600)]), WHOLE).samples
    )
    quality = DataSource(path, signal_map=WHOLE).inspect()
    assert any("behind the table" in f.what and f.where == "line 602" for r in quality.reports for f in r.findings)


@pytest.mark.parametrize(
    "bad",
    [
        ["12.0,0.5"],  # numbers in too few cells are damage, as elsewhere
        [*["word"] * (csv_leftovers.MAX_LAST_LINES + 1)],  # a text behind a table is no short end of it
        [NAMES.replace("s_arm", "s_bucket"), *rows(20, 900_000)],  # another table
    ],
)
def test_what_is_not_an_end_stays_damage(tmp_path, bad):
    path = save(tmp_path / "a.csv", [NAMES, *rows(600), *bad])
    with pytest.raises(DataError, match=r"line|text"):
        read_recording(path, WHOLE)


def test_hostile_repetitions(tmp_path):
    many = [line for row in rows(3000) for line in (NAMES, row)]
    made = read_recording(save(tmp_path / "a.csv", [NAMES, *many]), WHOLE)
    assert made.samples == read_recording(save(tmp_path / "b.csv", [NAMES, *rows(3000)]), WHOLE).samples
    with pytest.raises(DataError):
        read_recording(save(tmp_path / "c.csv", [NAMES] * 5000), WHOLE)
    wide = "\n".join([NAMES, *rows(400), NAMES, *rows(400, 900_000)]) + "\n"
    (tmp_path / "d.csv").write_bytes(wide.encode("utf-16"))
    with pytest.raises(DataError):  # of two bytes a letter it is refused as before, not misread
        read_recording(tmp_path / "d.csv", WHOLE)


def test_a_proposal_for_logs_that_move_one_lever_each(tmp_path):
    logs = tmp_path / "logs"
    save(logs / "boom.csv", [NAMES, *rows(76, 30_000), NAMES, *rows(1200)])
    save(logs / "arm.csv", [NAMES, *rows(900, seed=1, arm=True)], b"\x00\x00106307,0.0,0.0,1\x13,2,3,4\r\n")
    proposal = propose(logs)
    assert not proposal.broken
    assert (proposal.proposal.clock.column, proposal.proposal.clock.unit) == ("t", "ms")
    assert {guess.column for guess in proposal.proposal.select_role("command")} == {"x1", "y1"}
    # v_arm moves in one log, v_boom in the other; each is named as the change of a stroke.
    assert set(proposal.targets) == {"v_boom", "v_arm"}
    assert (
        'falling = "cut"' in proposal.files["data.toml"]
        if proposal.repairs == ()
        else "falling=cut" in proposal.repairs
    )
    assert any("begins anew in boom.csv" in note for note in proposal.notes)


def test_a_clock_without_a_name_that_loses_rows_is_time_and_is_not_predicted(tmp_path):
    names = ",".join(f"field_{i + 1}" for i in range(7))
    proposal = propose(save(tmp_path / "a.csv", [names, *rows(900)]))
    clock = proposal.proposal.clock
    assert (clock.column, clock.unit, clock.rate_hz) == ("field_1", "ms", pytest.approx(10.0))
    assert "field_1" not in proposal.targets


def test_what_rises_by_turns_is_no_clock(tmp_path):
    rng = np.random.default_rng(0)
    total = np.cumsum(rng.choice([1.0, 2.0, 3.0], 900))
    table = [f"{a:g},{b:.3f}" for a, b in zip(total, np.convolve(rng.standard_normal(900), np.ones(5))[:900])]
    proposal = propose(save(tmp_path / "a.csv", ["energy,force", *table]))
    assert proposal.proposal.clock.column is None


def test_small_steps_back_are_sorted_and_restarts_are_cut(tmp_path):
    table = rows(900)
    table[500:502] = reversed(table[500:502])
    assert propose(save(tmp_path / "a.csv", [NAMES, *table])).repairs == ("falling=sort",)
    with pytest.raises(Exception, match="falling = 'cute' is not one of refuse, sort, cut"):
        Repair(falling="cute")


def excavator(rows_count: int = 3000) -> dict[str, np.ndarray]:
    """Columns as loggers of excavators name them: stamps of messages, flags, rows numbered, the step between rows."""
    rng = np.random.default_rng(3)
    lever = np.repeat(rng.choice([0.0, -0.5, 1.0], rows_count // 60 + 1), 60)[:rows_count]
    speed = np.convolve(lever, np.full(30, 1 / 30))[:rows_count]
    stamps = np.cumsum(0.02 + 1e-3 * rng.standard_normal(rows_count))
    stale = (rng.random(rows_count) < 0.02).astype(float)
    return {
        "sample_index": np.arange(rows_count),
        "elapsed_s": stamps,
        "dt_s": np.append(0.02, np.diff(stamps)),
        "boom_cmd": lever,
        "boom_gyro_dps": 20 * speed + 0.1 * rng.standard_normal(rows_count),
        "pressure_ts": stamps[np.arange(rows_count) // 5 * 5],
        "pressure_stale": stale,
    }


def test_stamps_of_messages_flags_and_steps_between_rows_are_no_channels(tmp_path):
    columns = excavator()
    table = [",".join(f"{value:.6f}" for value in row) for row in np.stack(list(columns.values()), axis=1)]
    proposal = propose(save(tmp_path / "a.csv", [",".join(columns), *table]))
    assert proposal.proposal.clock.column == "elapsed_s"
    assert proposal.proposal.clock.rate_hz == pytest.approx(50, rel=0.02)
    roles = {guess.column: guess.role for guess in proposal.proposal.columns}
    assert {roles["pressure_ts"], roles["dt_s"]} == {"time"}
    assert (roles["pressure_stale"], roles["boom_cmd"]) == ("label", "command")
    assert proposal.targets == ("boom_gyro_dps",)
    units = {guess.column: guess.kind.unit for guess in proposal.proposal.columns}
    assert units["boom_gyro_dps"] == "deg/s"


def test_rows_numbered_by_name_are_no_clock_where_the_next_column_is_one(tmp_path):
    columns = excavator()
    columns["clock"] = columns.pop("elapsed_s")
    ordered = {name: columns[name] for name in ("sample_index", "clock", "boom_cmd", "boom_gyro_dps")}
    table = [",".join(f"{value:.6f}" for value in row) for row in np.stack(list(ordered.values()), axis=1)]
    assert propose(save(tmp_path / "a.csv", [",".join(ordered), *table])).proposal.clock.column == "clock"


@pytest.mark.parametrize("name", ["supply_ts", "valid", "online"])
def test_such_names_are_not_believed_of_columns_that_move_otherwise(tmp_path, name):
    columns = excavator()
    columns[name] = 5 + columns["boom_gyro_dps"] ** 2 + np.random.default_rng(0).standard_normal(3000)
    table = [",".join(f"{value:.6f}" for value in row) for row in np.stack(list(columns.values()), axis=1)]
    proposal = propose(save(tmp_path / "a.csv", [",".join(columns), *table]))
    assert {guess.column: guess.role for guess in proposal.proposal.columns}[name] == "measured"
