"""Long names in pictures: cut in their middle, still told apart, and of a size that a layout takes at once."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from edp.cli import app
from edp.report.common.wording import short_label, short_labels


@pytest.mark.parametrize("length", [0, 1, 31, 32])
def test_names_of_usual_length_stay(length):
    assert short_label("x" * length) == "x" * length


def test_the_middle_of_a_longer_one_is_left_out():
    name = "boom_" + "x" * 100_000 + "_rod_side"
    label = short_label(name)
    assert len(label) == 32
    assert (label[:5], label[-9:]) == ("boom_", "_rod_side")
    assert "…" in label


def test_names_that_differ_in_the_middle_are_told_apart():
    names = ["a" * 50 + str(number) + "b" * 50 for number in range(3)]
    assert len(set(short_labels(names))) == 3
    assert short_labels(["a", "b"]) == ("a", "b")


def test_a_screening_of_the_longest_names_draws_short_ones(tmp_path):
    rng = np.random.default_rng(0)
    names = ["time", "a" * 256, "b$_" * 85, "CylVels_1"]
    rows = np.column_stack([np.arange(2500) / 100, rng.standard_normal((2500, 3))])
    np.savetxt(tmp_path / "log.csv", rows, delimiter=",", header=",".join(names), comments="")
    out = tmp_path / "out"
    command = [
        "screen",
        str(tmp_path / "log.csv"),
        "--out",
        str(out),
        "--targets",
        "CylVels_1",
        "--horizon",
        "5",
        "--json",
    ]
    done = CliRunner().invoke(app, command)
    assert done.exit_code == 0, done.output
    drawn = (out / "pictures" / "importance.svg").read_text(encoding="utf-8")
    assert "a" * 21 not in drawn
    assert len(drawn) < 1_000_000
