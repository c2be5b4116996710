"""Forms of logs that other people's machines wrote: each made here from synthetic numbers."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from edp.logs import inspect_log
from edp.workflows.proposal import LogsProposal, propose

pytestmark = pytest.mark.processes


def swing(count: int, period: float = 90.0) -> np.ndarray:
    return np.sin(np.arange(count) * 2 * np.pi / period) + 0.1 * np.sin(np.arange(count) * 2 * np.pi / 17)


def rows_of(path: Path, head: Sequence[Sequence[str]], rows: Sequence[Sequence[object]], delimiter: str = ",") -> Path:
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream, delimiter=delimiter)
        writer.writerows(head)
        writer.writerows(rows)
    return path


def guesses(proposal: LogsProposal) -> dict[str, tuple[str, str, str, str]]:
    return {g.column: (g.role, str(g.kind.kind), g.kind.unit, g.sureness) for g in proposal.proposal.columns}


def test_units_above_names_and_a_clock_printed_in_few_digits(tmp_path):
    """Half a second of a pump at 4,800 Hz, stamps of a millisecond that repeat four or five times each."""
    count = 2400
    flow = 12 + swing(count)
    rows = [
        (
            f"{k / 4800:.3f}".replace(".", ","),
            f"{2500 - flow[k]:.2f}".replace(".", ","),
            f"{flow[k]:.5f}".replace(".", ","),
        )
        for k in range(count)
    ]
    head = [("s", "rpm", "l/min"), ("Time  Logger_1 CH=1", "n CH=2", "Q CH=5")]
    proposal = propose(rows_of(tmp_path / "valve.txt", head, rows, "\t"))
    found = guesses(proposal)
    assert found["Time Logger_1 CH=1"][0] == "time"
    assert found["n CH=2"] == ("measured", "angular_velocity", "rpm", "sure")
    assert found["Q CH=5"] == ("measured", "flow", "L/min", "sure")
    assert proposal.proposal.clock.rate_hz == pytest.approx(4800, rel=1e-3)
    # At 100 Hz some 50 rows would be left, at 2,000 Hz too few to test on.
    assert proposal.proposal.signal_map.rate_hz is None


def test_one_known_word_above_names_is_no_row_of_units(tmp_path):
    rows = [(f"{k / 100:.2f}", f"{v:.5f}", f"{v * v:.5f}") for k, v in enumerate(swing(500))]
    path = rows_of(tmp_path / "a.csv", [("rig 7", "V", "new oil"), ("time", "left", "right")], rows)
    found = guesses(propose(path))
    assert found["left"][2] == "1"


def test_joints_turn_and_speeds_in_rpm_are_those_of_shafts(tmp_path):
    count = 2000
    angle, torque = swing(count), np.cos(np.arange(count) / 31.0)
    speed = np.gradient(angle) * 100
    rig = {
        "time": np.arange(count) / 100,
        "position.elbow_joint": angle,
        "velocity.elbow_joint": speed,
        "Motor Speed [rpm]": 3000 + 90 * torque,
        "Torque (N·m)": torque,
        "Servo (us)": 1500 + np.round(100 * angle),
        "Left Load Cell (mV)": 3 * torque,
    }
    names, columns = tuple(rig), tuple(rig.values())
    rows = [[f"{column[k]:.6f}" for column in columns] for k in range(count)]
    found = guesses(propose(rows_of(tmp_path / "arm.csv", [names], rows)))
    assert found["position.elbow_joint"][1:] == ("angle", "rad", "likely")
    assert found["velocity.elbow_joint"][1:] == ("angular_velocity", "rad/s", "likely")
    assert found["Motor Speed"] == ("measured", "angular_velocity", "rpm", "sure")
    assert found["Torque"][1:3] == ("generic", "1")
    assert found["Servo"][0] == "command"
    assert found["Left Load Cell"][:3] == ("measured", "voltage", "mV")


def test_a_list_of_results_beside_the_table_is_no_channel(tmp_path):
    """Rows that are numbered, texts and numbers of a report beside the first of them, and a delimiter too many."""
    count = 1500
    place = 8000 + np.round(300 * swing(count))
    rows = [
        (k + 1, place[k], np.round(place[k] / 3), f"Variance_{k}" if k < 9 else "", k * 1.5 if k < 9 else "", "")
        for k in range(count)
    ]
    path = rows_of(tmp_path / "actuator.csv", [("Time", "PG_1", "PG_2", "F_Names", "F_Values", "")], rows)
    proposal = propose(path)
    found = guesses(proposal)
    assert found["F_Values"][0] == "remark"
    assert found["F_Names"][0] == "text"
    # Numbered rows may be seconds or not.
    assert found["Time"] == ("time", "generic", "1", "unsure")
    assert not any("nan" in repair for repair in proposal.repairs)
    assert inspect_log(path).errors == ()


def test_a_slow_sensor_in_a_fast_table_is_a_channel(tmp_path):
    count = 2000
    rows = [(f"{k / 100:.2f}", f"{v:.4f}", f"{20 + v:.3f}" if k % 50 == 0 else "") for k, v in enumerate(swing(count))]
    found = guesses(propose(rows_of(tmp_path / "a.csv", [("time", "p [bar]", "oil [degC]")], rows)))
    assert found["oil"][0] == "measured"


def test_columns_without_names_and_a_delimiter_at_the_end_are_inspected(tmp_path):
    rows = [(600 + int(50 * v), 700 - int(40 * v), "") for v in swing(800)]
    report = inspect_log(rows_of(tmp_path / "pump.csv", [], rows))
    assert report.errors == ()


def test_units_that_are_not_known_are_no_clash_where_no_map_was_given(tmp_path):
    rows = [(f"{k / 100:.2f}", f"{v:.4f}", f"{1500 + 90 * v:.2f}") for k, v in enumerate(swing(800))]
    report = inspect_log(rows_of(tmp_path / "a.csv", [("time", "pull [kgf]", "servo [us]")], rows))
    assert not any("the map says" in finding.what for finding in report.findings)


def test_an_axis_that_rests_in_the_first_log_is_that_of_another_one(tmp_path):
    """A rig that is tested one axis a log."""
    count = 1500
    for number in (1, 2):
        moved = 100 * swing(count)
        rest = np.full(count, 40.0)
        axes = (moved, rest) if number == 1 else (rest, moved)
        rows = [(f"{k / 100:.2f}", f"{axes[0][k]:.3f}", f"{axes[1][k]:.3f}") for k in range(count)]
        rows_of(tmp_path / f"axis_{number}.csv", [("time", "stroke_1 [mm]", "stroke_2 [mm]")], rows)
    found = guesses(propose(tmp_path))
    assert found["stroke_1"][:2] == found["stroke_2"][:2] == ("measured", "position")


def test_velocities_of_all_axes_are_predicted_where_one_of_them_shows_what_they_are(tmp_path):
    """Joints as robots log them: q1, q2, and qd1, qd2, of which the second is too noisy to show whose change it is."""
    count = 3000
    one, two = swing(count), 0.3 * swing(count, 130.0)
    noise = np.random.default_rng(0).normal(0, 0.05, count)
    columns = {"time": np.arange(count) / 100, "q1": one, "q2": two}
    columns |= {"qd1": np.gradient(one) * 100, "qd2": np.gradient(two) * 100 + 40 * noise}
    rows = [[f"{column[k]:.6f}" for column in columns.values()] for k in range(count)]
    proposal = propose(rows_of(tmp_path / "arm.csv", [tuple(columns)], rows))
    assert proposal.targets == ("qd1", "qd2")


def test_logs_too_short_to_train_on_are_said_to_be(tmp_path):
    rows = [(f"{k / 100:.2f}", f"{v:.4f}") for k, v in enumerate(swing(300))]
    notes = propose(rows_of(tmp_path / "a.csv", [("time", "p [bar]")], rows)).notes
    assert any("some 300 rows in all" in note for note in notes)
