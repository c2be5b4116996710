"""Logs of sister machines are named: balances of flow of all axes are off from the start on."""

from types import SimpleNamespace

import numpy as np
import pytest

from edp.monitor.machine_offsets import other_machine, scatter_of
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.session_blocks import SessionBlocks

BLOCKS, EACH, SETTLE = 300, 8, 5


class Axes(FlowBalances):
    """Balances of flow that judge these velocities; nothing else of them is asked for."""

    def __init__(self, *names):
        self.judged = tuple((name,) for name in names)


SOURCES = (SimpleNamespace(judged=(("OilTemperature",),)), Axes("boom", "boom", "arm"))
CHAIN = SimpleNamespace(
    summaries=SimpleNamespace(width=4 * EACH, residuals=4), settle=SETTLE, conditioning=lambda rows, points: rows
)


def healthy(seed):
    rows = np.random.default_rng(seed).normal(size=(BLOCKS, 4 * EACH))
    rows[:SETTLE] = np.nan
    return rows


@pytest.fixture(scope="module")
def scatter():
    sessions = [SessionBlocks(str(seed), healthy(seed), np.zeros((BLOCKS, 1))) for seed in range(40)]
    return scatter_of(CHAIN, sessions, 1.0)


def said(scatter, rows):
    return other_machine(SOURCES, CHAIN, scatter, rows, 1.0)


def shifted(columns, first=0):
    rows = healthy(100)
    rows[first:, columns] += 1.0
    return rows


def test_scatter_is_that_of_means_over_two_minutes(scatter):
    # Means of 120 normal numbers.
    np.testing.assert_allclose(scatter, 1.0 / np.sqrt(120.0), rtol=0.35)


def test_all_axes_that_are_off_from_the_start_are_another_machine(scatter):
    text = said(scatter, shifted([EACH + 2, 3 * EACH]))
    assert "all 2 axes" in text
    assert "chain.tolerance" in text


@pytest.mark.parametrize(
    ("columns", "first"),
    [([], 0), ([EACH, 2 * EACH], 0), ([3 * EACH], 0), ([0], 0), ([EACH, 3 * EACH], 130)],
    ids=["healthy", "the boom alone", "the arm alone", "no balance of flow", "both, but later"],
)
def test_a_fault_of_one_axis_or_a_later_one_is_none(scatter, columns, first):
    assert said(scatter, shifted(columns, first)) == ""


def test_short_logs_silent_balances_and_unknown_scatter_say_nothing(scatter):
    rows = shifted([EACH, 3 * EACH])
    assert said(scatter, rows[:100]) == ""
    silent = rows.copy()
    silent[:, EACH : 3 * EACH] = np.nan
    assert said(scatter, silent) == ""
    assert said(np.zeros_like(scatter), rows) == ""
