"""Time and copies in proposals: uneven clocks, logs of several rates, breaks, torn lines, columns logged twice."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from edp.errors import DataError
from edp.logs.read import read_recording
from edp.logs.source import DataSource, load_signal_map
from edp.signals import SignalMap
from edp.workflows.proposal import LogsProposal, propose, write_proposal
from edp.workflows.proposal.files import DATA, MAP

pytestmark = pytest.mark.processes

HEADER = "Time,lever_cmd,place_ms\n"


def stamps(count: int, step: float, seed: int = 0, start: float = 0.0) -> np.ndarray:
    """Rows of a logger that waits for others: steps between 0.8 and 1.3 of the usual one."""
    return start + np.cumsum(step * np.random.default_rng(seed).choice([0.8, 1.0, 1.0, 1.0, 1.3], count))


def lines(times: np.ndarray, seed: int = 0) -> list[str]:
    draw = np.random.default_rng(seed)
    lever = np.repeat(draw.uniform(-1, 1, len(times) // 40 + 1), 40)[: len(times)]
    place = np.cumsum(lever) + draw.normal(0, 0.02, len(times))
    return [f"{t:.6f},{u:.5f},{y:.5f}" for t, u, y in zip(times, lever, place)]


def save(path: Path, rows: list[str], header: str = HEADER) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(header + "\n".join(rows) + "\n")
    return path


def roles(proposal: LogsProposal) -> dict[str, str]:
    return {guess.column: guess.role for guess in proposal.proposal.columns}


def written(proposal: LogsProposal, folder: Path) -> DataSource:
    """The data as the proposed commands read it."""
    write_proposal(proposal, folder)
    if DATA in proposal.files:
        return DataSource.from_path(folder / DATA)
    return replace(proposal.source, signal_map=load_signal_map(folder / MAP))


def test_logs_of_several_rates_are_brought_to_one_so_that_training_can_read_them(tmp_path):
    logs = tmp_path / "logs"
    for i, step in enumerate((0.0520, 0.0530, 0.0541)):
        save(logs / f"run_{i}.csv", lines(stamps(600, step, i), i))
    proposal = propose(logs)
    assert proposal.proposal.clock.wanted_hz == 19.0
    assert any("differ in rate" in note for note in proposal.notes)
    assert {recording.rate_hz for recording in written(proposal, tmp_path / "here").read()} == {19.0}


def test_equal_rates_are_left_as_they_are(tmp_path):
    logs = tmp_path / "logs"
    for i in range(2):
        save(logs / f"run_{i}.csv", lines(np.arange(500) * 0.02 + i, i))
    proposal = propose(logs)
    assert proposal.proposal.clock.wanted_hz is None
    assert "rate_hz" not in proposal.files[MAP]


def test_repairs_come_from_all_logs_and_a_long_break_is_cut_in_its_own(tmp_path):
    logs = tmp_path / "logs"
    whole = np.arange(800) * 0.02
    save(logs / "longest.csv", lines(whole))
    save(logs / "short_gap.csv", lines(np.concatenate([whole[:300], whole[300:700] + 0.3]), 1))
    save(logs / "late.csv", lines(np.concatenate([[0.0], whole[:600] + 25.0]), 2))
    proposal = propose(logs)
    recordings = {recording.name: recording for recording in written(proposal, tmp_path / "here").read()}
    assert "gaps" in proposal.files[DATA]
    assert proposal.repairs == ()  # the data-set file has them
    assert recordings["late"].samples == 600
    assert 700 < recordings["short_gap"].samples < 720
    assert recordings["longest"].samples == 800


def test_one_kind_of_gap_is_an_option_of_the_command(tmp_path):
    logs = tmp_path / "logs"
    whole = np.arange(800) * 0.02
    save(logs / "a.csv", lines(whole))
    save(logs / "b.csv", lines(np.concatenate([whole[:300], whole[300:700] + 0.3]), 1))
    proposal = propose(logs)
    assert (proposal.repairs, DATA in proposal.files) == (("gaps=hold",), False)
    assert proposal.commands(tmp_path)[1].endswith("--repair gaps=hold")


def test_a_clock_without_a_name_that_is_not_quite_even_is_time(tmp_path):
    rows = lines(stamps(3000, 0.01, start=1017.78))
    proposal = propose(save(tmp_path / "arm.csv", rows, header=""))
    assert proposal.proposal.clock.column == "column_1"
    assert proposal.proposal.clock.rate_hz == pytest.approx(100.0, rel=0.05)
    # With a name that says nothing of time an uneven rise may be anything, the way along a track for one.
    named = propose(save(tmp_path / "track.csv", rows, header="way,lever_cmd,place_ms\n"))
    assert named.proposal.clock.column is None


def test_the_first_column_of_a_matrix_is_time_where_it_rises_evenly(tmp_path):
    times = np.arange(4000) * 1e-3
    draw = np.random.default_rng(0)
    data = np.column_stack([times, np.repeat(draw.normal(size=40), 100), draw.normal(size=4000)])
    scipy.io.savemat(tmp_path / "a.mat", {"gain": 0.5, "current": draw.normal(size=(4000, 1)), "data": data})
    proposal = propose(tmp_path / "a.mat")
    assert roles(proposal)["data_1"] == "time"
    assert proposal.proposal.clock.rate_hz == pytest.approx(1000.0)


def twice(path: Path, apart: bool = False, seed: int = 0) -> Path:
    """A position in V and in mm, each rounded; with `apart` the second one is another sensor's."""
    draw = np.random.default_rng(seed)
    place = 4 + np.sin(np.arange(2000) / 40 + seed) + draw.normal(0, 0.01, 2000)
    other = 13.3 * place - 47 + (draw.normal(0, 0.3, 2000) if apart else 0.0)
    force = draw.normal(0, 1, 2000)
    rows = [f"{0.01 * i:.2f},{a:.3f},{b:.3f},{c:.3f}" for i, (a, b, c) in enumerate(zip(place, other, force))]
    return save(path, rows, "t,volts,millimetres,load\n")


def test_a_column_that_repeats_another_one_in_another_unit_is_not_predicted_twice(tmp_path):
    proposal = propose(twice(tmp_path / "a.csv"))
    repeated = next(guess for guess in proposal.proposal.columns if guess.column == "millimetres")
    assert (repeated.channel, repeated.check) == ("", "a copy; not taken")
    assert "millimetres" not in proposal.files[MAP].split("[channels")[-1]
    assert "millimetres" not in proposal.targets
    kept = propose(twice(tmp_path / "b.csv", apart=True))
    assert all(guess.channel for guess in kept.proposal.columns if guess.role != "time")


def test_a_copy_that_hardly_moves_in_another_log_is_still_one(tmp_path):
    logs = tmp_path / "logs"
    twice(logs / "a.csv")
    quiet = twice(logs / "b.csv", seed=1)
    draw = np.random.default_rng(2)
    place = 4 + draw.normal(0, 0.003, 1000)  # some ten last digits
    rows = [f"{0.01 * i:.2f},{x:.3f},{13.3 * x - 47:.3f},{draw.normal():.3f}" for i, x in enumerate(place)]
    save(quiet, rows, "t,volts,millimetres,load\n")
    assert "millimetres" not in {guess.channel for guess in propose(logs).proposal.columns}


def test_a_copy_in_one_log_alone_is_a_channel(tmp_path):
    logs = tmp_path / "logs"
    twice(logs / "a.csv")
    twice(logs / "b.csv", apart=True, seed=1)
    proposal = propose(logs)
    assert "millimetres" in {guess.channel for guess in proposal.proposal.columns}


def test_a_last_line_that_was_never_finished_is_left_out_and_told(tmp_path):
    rows = lines(np.arange(600) * 0.02)
    path = save(tmp_path / "a.csv", rows)
    path.write_text(path.read_text() + "12.000000,0.5")
    recording = read_recording(path, SignalMap(others=True))
    assert recording.samples == 600
    quality = DataSource(path).inspect()
    assert any("never finished" in finding.what for report in quality.reports for finding in report.findings)
    # A finished line with a cell too few is damage, at the end as elsewhere.
    path.write_text("\n".join([HEADER.strip(), *rows]) + "\n12.000000,0.5\n")
    with pytest.raises(DataError, match="line 602 has 2 cells, the header has 3"):
        read_recording(path, SignalMap(others=True))
    path.write_text("\n".join([HEADER.strip(), *rows[:5], "0.1,0.5", *rows[5:]]) + "\n12.000000,0.5")
    with pytest.raises(DataError, match="line 7 has 2 cells"):
        read_recording(path, SignalMap(others=True))


def test_inspection_goes_on_behind_a_file_that_cannot_be_read(tmp_path):
    logs = tmp_path / "logs"
    save(logs / "a.csv", lines(np.arange(600) * 0.02))
    (logs / "b.csv").write_bytes(b"\x00\x01" * 4000)
    quality = DataSource(logs).inspect()
    assert [report.verdict for report in quality.reports] == ["good", "unusable"]
    with pytest.raises(DataError):
        DataSource(logs / "b.csv").inspect()
