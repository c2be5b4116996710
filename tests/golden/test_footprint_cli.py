"""``edp footprint`` on the thesis's settings prints the counts that the thesis prints (Tables B.1, 4.8, 4.9)."""

import json
import sys
from pathlib import Path

import pytest

from edp.cli import app
from edp.cli.console import run_app

FOLDER = Path(__file__).parents[2] / "examples" / "thesis"
# Parameters as stored; MACs of a window in M to three digits as printed; MACs per tick in k to four digits.
PRINTED = {
    "table_b1": (1_376_775, "62.88", "1379"),
    "k10_teacher": (1_197_319, "45.198", "1206"),
    "k10_student_u64": (84_292, "3.257", "86.6"),
    "k10_student_u32": (24_228, "0.958", "25.4"),
    "k1_teacher_p4": (677_572, "31.281", "680.5"),
    "k1_student_u64": (181_956, "8.409", "183.6"),
    "k1_student_u32": (53_604, "2.486", "54.4"),
    # Their multiply-accumulates are our own count: the printed ones take recurrent layer and bridge once, not 50 times.
    "k1_teacher_p5": (703_527, "33.23", "710.4"),
    "k1_student_p5_u64": (213_972, "10.37", "220.4"),
    "k1_student_p5_u32": (61_996, "3.06", "65.2"),
}
FOLDED = {
    "k10_teacher": 1_196_804,
    "k10_student_u64": 84_164,
    "k1_teacher_p4": 676_676,
    "k1_student_u64": 181_572,
    "k1_teacher_p5": 702_628,
    "k1_student_p5_u64": 213_588,
}


def test_every_file_is_held_to_the_table():
    assert sorted(path.stem for path in FOLDER.glob("*.toml")) == sorted(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_counts(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["edp", "footprint", str(FOLDER / f"{name}.toml"), "--json"])
    assert run_app(app) == 0
    counts = json.loads(capsys.readouterr().out)
    parameters, window, tick = PRINTED[name]
    assert counts["parameters"] == parameters
    assert f"{counts['macs_window'] / 1e6:.{len(window.partition('.')[2])}f}" == window
    assert f"{counts['macs_tick'] / 1e3:.{len(tick.partition('.')[2])}f}" == tick
    if name in FOLDED:
        assert counts["parameters_folded"] == FOLDED[name]
    assert counts["window"] == 50
