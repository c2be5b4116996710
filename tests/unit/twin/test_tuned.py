"""A grey box that follows a machine: it finds what changed, stays within bounds, and is taken back where it harms."""

import numpy as np
import pytest

from edp.data.twin_channels import twin_channels
from edp.errors import ConfigError
from edp.networks.twin import TWINS, fit_scales
from edp.networks.twin.adaptive_correction import TunedCorrection
from edp.networks.twin.adaptive_twin import BOUND, NUMBER_GROUPS, AdaptiveTwin, TunedSpec, group_matrix
from edp.testing.bench import bench_channels, bench_series
from edp.testing.twins import sample_actuators

from .test_grey_box import BENCH

BAND = TunedSpec(groups=("dead_band",), load_share=0.0)
K = 5


@pytest.fixture(scope="module")
def bench():
    """A grey box of a cylinder, and a machine whose dead bands are half as wide again, driven for 12 s."""
    channels, series = bench_channels(), [bench_series(1200, seed) for seed in range(2)]
    twin = BENCH.start(channels, fit_scales(channels, series), series, 0)
    numbers = twin.table.nominal
    numbers[twin.table.inertia_at], numbers[twin.table.potential_at] = 0.07, 0.01  # 4.9 t, 20 kN
    twin, levers = twin.with_parameters(numbers), series[0].inputs
    _, moves, _, _ = group_matrix(twin, ("dead_band",))
    worn = twin.with_parameters(twin.numbers * np.exp(moves @ [np.log(1.5)]))
    start = np.array([[0.0, 0.5, 5e6, 5e6, 5e6]], np.float32)
    answers, _ = worn.rollout(levers[None, :-1], worn.initial_state(levers[None, 0], start))
    return twin, levers, np.concatenate([start, answers[0]])


def followed(tuned, levers, measured):
    for command, row in zip(levers, measured, strict=True):
        tuned.step(command, row)
    return tuned


@pytest.mark.long
def test_it_finds_a_wider_dead_band_and_forecasts_with_it(bench):
    twin, levers, measured = bench
    tuned = followed(AdaptiveTwin(twin, BAND), levers[:-K], measured[:-K])
    assert tuned.labels == ("ram.dead_band",)
    assert np.exp(tuned.logs[0]) == pytest.approx(1.5, rel=0.05)
    frozen = AdaptiveTwin(twin, BAND)
    frozen.learn = False
    errors = [[], []]
    for at, (command, row) in enumerate(zip(levers[:-K], measured[:-K], strict=True)):
        for one, kept in zip((tuned, frozen), errors, strict=True):
            one.step(command, row)
            if at > 100:
                kept.append(abs(one.forecast(K)[0] - measured[at + K, 0]))
    assert np.mean(errors[0]) < 0.8 * np.mean(errors[1])


def test_a_machine_as_it_was_teaches_nothing(bench):
    twin, levers, measured = bench
    answers, _ = twin.rollout(levers[None, :-1], twin.initial_state(levers[None, 0], measured[None, 0]))
    tuned = followed(AdaptiveTwin(twin, BAND), levers[1:], answers[0])
    assert tuned.learned > 20
    np.testing.assert_allclose(tuned.logs, 0.0, atol=5e-3)


def test_noise_faults_and_gaps_leave_numbers_within_their_bounds(bench):
    twin, levers, measured = bench
    rng = np.random.default_rng(0)
    rough = (measured + rng.normal(0, [0.3, 0.05, 1e6, 1e6, 1e6], measured.shape)).astype(np.float32)
    rough[100:110, 0], rough[200] = np.nan, np.nan
    lever = levers.copy()
    lever[300] = np.nan
    tuned = followed(AdaptiveTwin(twin), lever, rough)
    deviations = np.array([NUMBER_GROUPS[name].deviation for name in tuned.spec.groups])
    assert (np.abs(tuned.logs) <= BOUND * deviations).all()
    assert np.isfinite(tuned.forecast(K)).all()


def test_frozen_it_learns_nothing_and_a_gap_keeps_what_was_learned(bench):
    twin, levers, measured = bench
    tuned = AdaptiveTwin(twin, BAND)
    tuned.learn = False
    followed(tuned, levers[:200], measured[:200])
    assert (tuned.learned, tuned.logs.tolist()) == (0, [0.0])
    tuned.learn = True
    followed(tuned, levers, measured)
    learned = tuned.logs.copy()
    tuned.interrupt()
    assert tuned.forecast(K) is None
    np.testing.assert_array_equal(tuned.logs, learned)
    tuned.reset()
    assert tuned.logs.tolist() == [0.0]


def corrected(correction, levers, measured, predictions):
    rows = zip(levers, measured, predictions, strict=True)
    return np.stack([correction.step(lever, row, one[None]) for lever, row, one in rows])[:, 0]


@pytest.mark.long
def test_predictions_move_to_what_is_better_and_stay_where_nothing_is(bench):
    twin, levers, measured = bench
    limit = np.full((1, 1), 0.5)
    truth = np.concatenate([measured[K:, :1], np.repeat(measured[-1:, :1], K, axis=0)])
    correction = TunedCorrection(AdaptiveTwin(twin, BAND), ["speed"], [K], limit)
    # A network that knows all is not moved; one that says what is now has much to gain.
    np.testing.assert_allclose(corrected(correction, levers, measured, truth), truth, atol=1e-6)
    assert correction.weight.max() < 1e-6
    correction.reset()
    present = measured[:, :1]
    moved = corrected(correction, levers, measured, present)
    late = slice(-150, -K)
    assert np.abs(moved[late] - truth[late]).mean() < 0.8 * np.abs(present[late] - truth[late]).mean()
    np.testing.assert_array_equal(moved[:900], present[:900])  # before ten seconds of motion
    tight = TunedCorrection(AdaptiveTwin(twin, BAND), ["speed"], [K], limit * 1e-3)
    assert 0 < np.abs(corrected(tight, levers, measured, present) - present).max() <= 5e-4 * (1 + 1e-3)
    assert np.isnan(tight.step(levers[0], measured[0], np.full((1, 1), np.nan))).all()


def test_a_thermometer_tells_the_oil_at_once(bench):
    twin, levers, measured = bench
    tuned = AdaptiveTwin(twin, TunedSpec(oil_c=20.0))
    tuned.step(levers[0], measured[0], 60.0)
    assert tuned.factors["oil"] == pytest.approx(np.exp(-1.4))
    assert tuned.factors["ram.friction"] == tuned.factors["ram.dead_band"] == 1.0
    for broken in (np.nan, np.inf, 4000.0):
        tuned.step(levers[1], measured[1], broken)
    assert tuned.factors["oil"] == pytest.approx(np.exp(-1.4))
    unknown = AdaptiveTwin(twin)
    unknown.step(levers[0], measured[0], 60.0)
    assert unknown.factors["oil"] == 1.0


def test_thinner_oil_leaks_more_rubs_less_and_is_softer(bench):
    twin = bench[0]
    labels, moves, _, _ = group_matrix(twin, ("oil",))
    assert labels == ("oil",)
    thin = np.exp(moves @ [np.log(0.2)])
    factors = {number.name: factor for number, factor in zip(twin.table.numbers, thin, strict=True) if factor != 1.0}
    assert factors["piston_leakage"] == factors["spool_leakage"] == pytest.approx(5.0)
    assert factors["viscous"] == pytest.approx(0.2**0.5)
    assert factors["bulk_modulus"] == pytest.approx(0.83, abs=0.01)
    assert len(factors) == 4


def test_equations_that_come_apart_begin_anew(bench):
    twin, levers, measured = bench
    tuned = followed(AdaptiveTwin(twin, BAND), levers[:100], measured[:100])
    assert np.isfinite(tuned.forecast(K)).all()
    tuned._state = {name: np.full_like(rows, np.nan) for name, rows in tuned._state.items()}
    tuned.step(levers[100], measured[100])
    assert tuned.forecast(K) is None
    followed(tuned, levers[101:200], measured[101:200])
    assert np.isfinite(tuned.forecast(K)).all()


def test_what_cannot_follow_is_refused(bench):
    twin = bench[0]
    with pytest.raises(ConfigError, match="unknown group of numbers 'dead_bands'"):
        TunedSpec(groups=("dead_bands",))
    with pytest.raises(ConfigError, match="groups is empty"):
        TunedSpec(groups=())
    with pytest.raises(ConfigError, match="learn_ticks"):
        TunedSpec(learn_ticks=1)
    with pytest.raises(ConfigError, match="oil_c = 400"):
        TunedSpec(oil_c=400.0)
    tuned = AdaptiveTwin(twin, BAND)
    with pytest.raises(ConfigError, match="'swing' is predicted, but no velocity"):
        TunedCorrection(tuned, ["swing"], [K], np.ones((1, 1)))
    with pytest.raises(ConfigError, match="limit"):
        TunedCorrection(tuned, ["speed"], [K], np.zeros((1, 1)))
    with pytest.raises(ConfigError, match="horizons"):
        TunedCorrection(tuned, ["speed"], [0], np.ones((1, 1)))
    recording = sample_actuators(seed=1)
    channels = twin_channels(recording)
    series = [channels.task().series(recording)]
    static = TWINS["static"]().start(channels, fit_scales(channels, series), series, 0)
    with pytest.raises(ConfigError, match="only a grey box"):
        AdaptiveTwin(static)
