"""What `edp data check` says of logs with breaks, and of logs whose channels have no kind."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from edp.workflows.proposal import propose, write_proposal
from edp.workflows.proposal.files import DATA


def save(path: Path, times: np.ndarray, seed: int = 0) -> Path:
    draw = np.random.default_rng(seed)
    lever = np.repeat(draw.uniform(-1, 1, len(times) // 40 + 1), 40)[: len(times)]
    place = np.cumsum(lever) + draw.normal(0, 0.02, len(times))
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{t:.6f},{u:.5f},{y:.5f}" for t, u, y in zip(times, lever, place, strict=True)]
    path.write_text("\n".join(["Time,lever_cmd,place_ms", *rows]) + "\n")
    return path


def test_gaps_are_one_finding_and_a_repair_of_the_data_set_makes_them_a_warning(edp, tmp_path):
    logs = tmp_path / "logs"
    whole = np.arange(800) * 0.02
    save(logs / "a.csv", whole)
    save(logs / "gap.csv", np.concatenate([whole[:300], whole[300:700] + 0.3]), 1)
    save(logs / "late.csv", np.concatenate([[0.0], whole[:600] + 25.0]), 2)
    assert edp("data", "check", logs).out.count("error:") == 1
    write_proposal(propose(logs), tmp_path / "here")
    shown = edp("data", "check", tmp_path / "here" / DATA).out
    assert "error:" not in shown
    assert "repaired when it is read: gaps = cut" in shown
    # What comes next has the settings that lie beside the data-set file.
    assert f"--config {tmp_path / 'here' / 'settings.toml'} --out {tmp_path / 'here' / 'runs' / 'first'}" in shown


def test_numbers_of_no_kind_are_named_instead_of_counted_as_motion(edp, tmp_path):
    logs = tmp_path / "logs"
    save(logs / "a.csv", np.arange(800) * 0.02)
    proposal = propose(logs)
    write_proposal(proposal, tmp_path / "here")
    command = proposal.commands(tmp_path / "here")[0]
    assert "--inputs lever_cmd" in command
    shown = edp(*command.split()[1:], "--details").out
    assert "lever_cmd: flat within 10 dB" in shown
    assert "place_ms are numbers of no kind" in shown
    assert "Joint histograms" not in shown
    assert "How often" not in shown
