"""Estimates of what a controller spends on a network, and budgets from files."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from edp.data.features import FG2
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.errors import ConfigError
from edp.evaluation.controller import CORES, FORMATS, Budget, load_budget
from edp.evaluation.footprint import check_possible, footprint
from edp.networks.backbones import CommitteeSpec, HybridSpec
from edp.networks.heads import LinearHead, MlpHead
from edp.networks.predictor import ModelSpec, build_model

BUDGETS = sorted((Path(__file__).parents[2] / "examples" / "budgets").glob("*.toml"))


def network(channels, units, hidden=32):
    return network_of(HybridSpec(channels=(channels,) * 4, kernel=3, units=units), MlpHead(hidden=hidden))


def network_of(backbone, head):
    task = Task(FG2, ("CylVels_1", "CylVels_2", "CylVels_3"), (10,), TargetMode.DELTA, 100.0)
    scaler = Scaler(np.zeros(30), np.ones(30), np.zeros((1, 3)), np.ones((1, 3)))
    return build_model(task, ModelSpec(backbone=backbone, head=head, window=50), scaler, seed=0)


# Cycles of a step of the exported code (w8a16, float32), counted by benchmarks/controller_cycles.py.
COUNTED = {
    (32, 32): (145_208, 196_280),
    (32, 64): (213_715, 304_299),
    (64, 64): (372_901, 587_744),
    (64, 128): (564_897, 920_499),
}
# Bytes of flash (benchmarks/program_bytes.py), and of state and stack (benchmarks/controller_memory.py), of the
# exported code (w8a16, float32).
LINKED = {
    (32, 32): ((54_136, 9_688), (167_660, 15_828)),
    (32, 64): ((78_500, 14_168), (258_420, 22_868)),
    (64, 64): ((157_636, 17_816), (565_764, 30_420)),
    (64, 128): ((239_124, 27_160), (878_348, 45_012)),
}


@pytest.mark.parametrize(("channels", "units"), COUNTED)
def test_estimates_of_cycles_are_those_of_the_exported_code(channels, units):
    by_format = {entry.number_format: entry for entry in footprint(network(channels, units)).estimates}
    for name, counted in zip(("w8a16", "float32"), COUNTED[channels, units], strict=True):
        low, typical, high = by_format[name].cycles["cortex_m4f"]
        assert low == pytest.approx(counted, rel=0.07)
        assert (typical, high) == (pytest.approx(1.26 * low, abs=2), pytest.approx(1.43 * low, abs=2))


# Likewise, of committees of two groups of 4 perceptrons of 32 units, by trees and their depth.
WITH_TREES = {(60, 4): (213_683, 328_125), (200, 6): (263_603, 389_563)}


@pytest.mark.parametrize(("trees", "depth"), WITH_TREES)
def test_steps_of_trees_take_the_cycles_that_were_counted(trees, depth):
    by_format = {}
    for backbone in (CommitteeSpec(members=4, units=32, trees=n, tree_depth=depth) for n in (0, trees)):
        counts = footprint(network_of(backbone, LinearHead()))
        by_format[backbone.trees] = {entry.number_format: entry.cycles["cortex_m4f"][0] for entry in counts.estimates}
    for name, counted in zip(("w8a16", "float32"), WITH_TREES[trees, depth], strict=True):
        assert by_format[trees][name] == pytest.approx(counted, rel=0.12)
        # Per output a comparison a level and a leaf; the three sums are features that are written.
        each = (by_format[trees][name] - by_format[0][name] - 3 * FORMATS[name].per_output) / (3 * trees * (depth + 1))
        assert each == pytest.approx(FORMATS[name].per_tree_step, rel=0.05)


@pytest.mark.parametrize(("channels", "units"), LINKED)
def test_estimates_of_memory_are_those_of_the_exported_code(channels, units):
    by_format = {entry.number_format: entry for entry in footprint(network(channels, units)).estimates}
    for name, (flash, used) in zip(("w8a16", "float32"), LINKED[channels, units], strict=True):
        assert by_format[name].flash_bytes == pytest.approx(flash, rel=0.01)
        assert used <= by_format[name].ram_bytes <= 1.3 * used


def test_estimates_rise_from_low_to_high_and_no_core_is_promised_to_beat_an_m4():
    for entry in footprint(network(16, 16)).estimates:
        assert set(entry.cycles) == set(CORES)
        for low, typical, high in entry.cycles.values():
            assert low <= typical <= high
            assert high == entry.cycles["cortex_m4f"][2]


def test_the_verdict_is_that_of_the_high_estimate():
    counts = footprint(network(64, 64))
    low, _, high = counts.estimates[1].cycles["cortex_m4f"]
    for cycles, fits in ((low, False), (high - 1, False), (high, True)):
        rows = {row.what: row for row in counts.verdict(Budget(cycles=cycles))}
        assert rows["cycles per tick, w8a16"].fits is fits
    assert {f"{what}, {name}" for what in ("parameters", "RAM", "flash") for name in FORMATS} < set(rows)
    assert rows["parameters, w8a16"].value == counts.estimate("w8a16").parameter_bytes


@pytest.mark.parametrize("path", BUDGETS, ids=lambda path: path.stem)
def test_budgets_of_the_examples_are_read(path):
    assert load_budget(path) != Budget()


def test_what_a_budget_leaves_out_is_as_in_the_thesis(tmp_path):
    (tmp_path / "small.toml").write_text("cycles = 360_000\n")
    assert load_budget(tmp_path / "small.toml") == Budget(name="small", cycles=360_000)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("cycle = 5", "unknown key 'cycle'; did you mean 'cycles'"),
        ("cycles = 0", "cycles = 0; integers, 1 <= cycles"),
        ("cycles = true", "cycles = True: true and false are no numbers"),
        (
            "cycles = 1.5\nname = 3",
            r"2 problems\n.*name = 3: a text in quotes must hold\n.*cycles = 1.5: an integer must hold",
        ),
        ("core = 'cortex_m5'", "core = 'cortex_m5' is not known; did you mean"),
        ("cycles = ", "is not valid TOML"),
    ],
)
def test_budgets_that_cannot_be_are_refused(tmp_path, text, message):
    path = tmp_path / "budget.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        load_budget(path)


def test_a_budget_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml' cannot be read: No such file"):
        load_budget(tmp_path / "none.toml")


def test_a_budget_that_nobody_can_meet_is_refused_with_what_the_smallest_network_takes():
    least = footprint(network(1, 1, hidden=1))
    needed = min(entry.cycles["cortex_m4f"][2] for entry in least.estimates)
    check_possible(Budget(cycles=needed), least)
    impossible = dataclasses.replace(Budget(), cycles=needed - 1, flash_bytes=4_000)
    with pytest.raises(ConfigError, match=f"cycles = {needed - 1:,}, flash_bytes = 4,000 can be met by no network"):
        check_possible(impossible, least)
