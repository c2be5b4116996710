"""Strokes beside the integrals of their velocities: what units, signs, lags and noise make of the ratio."""

import numpy as np
import pytest

from edp.config.twin import TwinExperiment
from edp.data.coverage import cover
from edp.data.integrals import contradiction, integral_fit
from edp.errors import DataError
from edp.networks.twin.static_map import StaticMap
from edp.recording import Recording
from edp.report.coverage.page import build_coverage_page
from edp.signals import Channel, Kind
from edp.testing.twins import sample_actuators
from edp.workflows.twin.prepare_twin import cut_recordings

RATE = 50.0


def driven(seed=0, ticks=2000):
    """A velocity in steps with a lag, and its stroke."""
    rng = np.random.default_rng(seed)
    goal = np.repeat(rng.uniform(-0.3, 0.3, ticks // 50), 50)
    velocity = np.convolve(goal, 0.2 * 0.8 ** np.arange(40))[:ticks]
    stroke = np.concatenate([[0.0], np.cumsum(0.5 * (velocity[1:] + velocity[:-1]))]) / RATE
    return velocity, stroke


@pytest.mark.parametrize("scale", [1.0, -1.0, 0.5, 57.3])
def test_the_ratio_is_the_scale_between_the_two(scale):
    fit = integral_fit([(velocity, scale * stroke) for velocity, stroke in map(driven, range(3))], RATE)
    assert (fit.ratio, fit.correlation) == pytest.approx((scale, np.sign(scale)), rel=1e-9)
    assert fit.contradicts == (scale != 1.0)


def test_noise_of_sensors_lag_and_coarse_steps_are_no_contradiction():
    velocity, stroke = driven()
    rng = np.random.default_rng(1)
    noisy = velocity + rng.normal(0, 0.1, velocity.shape)
    late = np.concatenate([np.zeros(8), np.round(stroke, 2)[:-8]])
    fit = integral_fit([(noisy, late)], RATE)
    assert 0.9 < fit.ratio < 1.1
    assert not fit.contradicts


def test_what_rests_and_what_goes_its_own_way_is_no_contradiction():
    velocity, stroke = driven()
    assert integral_fit([(velocity, 0.0 * stroke)], RATE).correlation == 0.0
    _, other = driven(seed=9)
    for fit in (integral_fit([(velocity, other)], RATE), integral_fit([(velocity[:4], stroke[:4])], RATE)):
        assert not fit.contradicts


def rescaled(recording, name, scale):
    values = recording.values.copy()
    values[:, recording.index(name)] *= scale
    return Recording(recording.name, recording.channels, values, recording.rate_hz, recording.source)


def test_a_twin_is_not_trained_on_a_stroke_in_another_unit():
    recordings = [rescaled(sample_actuators(seed=seed), "stroke_2", 1e3) for seed in range(4)]
    with pytest.raises(
        DataError, match=r"'stroke_2' changes by 1e\+03 times what velocity 'speed_2' adds up to.*scale"
    ):
        cut_recordings(recordings, TwinExperiment(twin=StaticMap(prefix_ticks=5)))
    fine = [sample_actuators(seed=seed) for seed in range(4)]
    assert cut_recordings(fine, TwinExperiment(twin=StaticMap(prefix_ticks=5)))[0].strokes


def test_a_twin_is_not_trained_on_commands_that_never_move():
    recordings = [rescaled(rescaled(sample_actuators(seed=seed), "lever_1", 0.0), "lever_2", 0.0) for seed in range(4)]
    with pytest.raises(DataError, match=r"no command \('lever_1', 'lever_2'\) changes in the training recordings"):
        cut_recordings(recordings, TwinExperiment(twin=StaticMap(prefix_ticks=5)))
    one = [rescaled(sample_actuators(seed=seed), "lever_1", 0.0) for seed in range(4)]
    assert cut_recordings(one, TwinExperiment(twin=StaticMap(prefix_ticks=5)))[0].commands


def test_coverage_says_so_and_asks_nothing_of_what_is_no_velocity():
    recordings = [rescaled(sample_actuators(seed=seed), "stroke_1", -1.0) for seed in range(3)]
    (told,) = cover(recordings).contradictions
    assert "'stroke_1' changes by -1 times" in told
    assert "Stroke &#39;stroke_1&#39; changes by -1 times" in build_coverage_page(cover(recordings), "logs").html()
    assert cover([sample_actuators(seed=1)]).contradictions == ()
    velocity, stroke = driven()
    channels = (Channel("lever", Kind.RATIO), Channel("force", Kind.FORCE), Channel("stroke", Kind.POSITION))
    values = np.stack([velocity, velocity, 1e3 * stroke], axis=1).astype(np.float32)
    assert cover([Recording("one", channels, values, RATE, "sample")]).contradictions == ()


def test_the_message_names_both_and_the_scale_that_would_mend_it():
    text = contradiction("v", "s", integral_fit([(driven()[0], 0.5 * driven()[1])], RATE))
    assert "(scale = 0.5 for 'v', if it is the wrong one)" in text
