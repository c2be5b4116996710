"""The static map's delay where logs are short: every delay is judged by the same stretches."""

from dataclasses import replace

import numpy as np
import pytest

from edp.networks.twin import fit_scales
from edp.networks.twin.static_map import StaticMap
from edp.testing.twins import sample_series

DELAYS = (0, 4, 8, 16)


def with_delay(part, ticks):
    """The stretch with answers that much later."""
    return replace(part, targets=np.concatenate([np.repeat(part.targets[:1], ticks, axis=0), part.targets[:-ticks]]))


def cut(part, ticks):
    return replace(part, inputs=part.inputs[:ticks], targets=part.targets[:ticks])


def delay_of(channels, train):
    scales = fit_scales(channels, train)
    return int(StaticMap(delays=DELAYS, prefix_ticks=2).start(channels, scales, train, 0).numbers["delay"][0])


def test_logs_shorter_than_a_delay_do_not_choose_it():
    channels, series = sample_series(3)
    longer = [with_delay(part, 8) for part in series]
    alone = delay_of(channels, longer)
    assert alone == delay_of(channels, [*longer, *(cut(part, 10) for part in series)])
    assert alone >= 8


@pytest.mark.parametrize(("ticks", "most"), [(18, 16), (10, 8), (6, 4), (3, 0)])
def test_a_delay_longer_than_every_log_is_left_out(ticks, most):
    channels, series = sample_series(3)
    assert delay_of(channels, [cut(part, ticks) for part in series]) <= most
