"""Long names in pictures: cut in their middle, still told apart, and of a size that a layout takes at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import edp
from edp.cli import app
from edp.wording import MAX_LABEL, label_by_name, short_labels


@pytest.mark.parametrize("length", [0, 1, 31, 32])
def test_names_of_usual_length_stay(length):
    assert short_labels(["x" * length]) == ("x" * length,)


def test_the_middle_of_a_longer_one_is_left_out():
    name = "boom_" + "x" * 100_000 + "_rod_side"
    label = short_labels([name])[0]
    assert len(label) == 32
    assert (label[:5], label[-9:]) == ("boom_", "_rod_side")
    assert "…" in label


def test_names_that_differ_in_the_middle_are_told_apart():
    names = ["a" * 50 + str(number) + "b" * 50 for number in range(3)]
    assert len(set(short_labels(names))) == 3
    assert short_labels(["a", "b"]) == ("a", "b")


def test_what_tells_names_apart_stays_in_sight():
    start, end = "hydraulic_test_rig_main_cylinder_", "_bar_filtered_at_100_hz_by_logger"
    labels = short_labels([f"{start}pressure_{side}{end}" for side in ("head", "rod")])
    assert "head" in labels[0]
    assert "rod" in labels[1]
    assert max(map(len, labels)) <= MAX_LABEL


PARTS = st.sampled_from(["pressure", "rod", "head", "bar", "cylinder", "main", "1", "2", "velocity", "ä", "…"])


@given(st.lists(st.lists(PARTS, min_size=1, max_size=12).map("_".join) | st.text(max_size=80), max_size=12))
def test_labels_differ_where_names_differ_and_are_short(names):
    labels = short_labels(names)
    assert len(labels) == len(names)
    for name, label in zip(names, labels, strict=True):
        assert len(label) <= MAX_LABEL + len(f" ({len(names)})")
        if len(name) <= MAX_LABEL and names.count(name) == 1 and labels.count(name) == 1:
            assert label == name or label.startswith(f"{name} (")
    by_name = label_by_name(names)
    assert len(set(by_name.values())) == len(by_name) or any(" (" in name or "…" in name for name in names)


@given(
    st.text("ab_", max_size=40),
    st.text("ab_", max_size=40),
    st.sets(st.text("cdef", min_size=1, max_size=8), min_size=2),
)
def test_the_one_part_that_differs_is_in_every_label(start, end, parts):
    names = sorted(f"{start}|{part}|{end}" for part in parts)
    assert len(set(short_labels(names))) == len(names)
    for label in short_labels(names):
        assert " (" not in label


def test_reports_shorten_names_at_one_place():
    source = Path(edp.__file__).parent
    cutting = [path for path in source.rglob("*.py") if "\N{HORIZONTAL ELLIPSIS}" in path.read_text("utf-8")]
    assert [path.name for path in cutting if "report" in path.parts or path.parent == source] == ["wording.py"]


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
