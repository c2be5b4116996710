"""How long free runs are along slow and short logs."""

from dataclasses import replace

import pytest

from edp.training.free_run import FreeRunSpec
from edp.workflows.twin.pace import paced

USUAL = FreeRunSpec()


def ticks(training, rate_hz):
    return [round(length * rate_hz) for length in (*training.lengths_s, training.validation_s)]


@pytest.mark.parametrize("rate_hz", [10.0, 50.0, 100.0])
def test_logs_of_usual_rate_and_length_keep_the_lengths_in_seconds(rate_hz):
    assert paced(USUAL, rate_hz, 1000) is USUAL


@pytest.mark.parametrize(
    ("rate_hz", "block", "lengths"),
    [
        (0.25, 1000, [12, 25, 50, 100, 150]),
        (1.0, 100, [6, 12, 25, 50, 75]),
        (50.0, 50, [3, 6, 12, 25, 38]),
    ],
)
def test_a_slow_or_short_log_has_lengths_in_ticks_that_a_fold_can_hold(rate_hz, block, lengths):
    got = ticks(paced(USUAL, rate_hz, block), rate_hz)
    assert got == pytest.approx(lengths, abs=1)
    assert max(got[:-1]) <= block // 2


def test_lengths_that_settings_name_stay():
    named = replace(USUAL, lengths_s=(0.1, 0.3, 1.0, 2.0))
    assert paced(named, 0.25, 1000) is named
    judged = replace(USUAL, validation_s=20.0)
    assert paced(judged, 0.25, 1000) is judged


def test_a_log_too_short_for_any_stage_is_left_to_the_refusals_of_the_training():
    assert paced(USUAL, 1.0, 20) is USUAL
