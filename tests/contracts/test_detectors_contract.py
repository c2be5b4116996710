"""Every registered detector: streams side by side and what is missing; plain forms and published run lengths."""

import math

import numpy as np
import pytest
from scipy.stats import chi2

from edp.errors import ConfigError, DataError, count_of
from edp.monitor.calibration import calibrated, hours_between
from edp.monitor.detectors import (
    DETECTORS,
    CusumSpec,
    EDetectorSpec,
    EwmaSpec,
    GlrSpec,
    SeparateCusumsSpec,
    alarms,
    statistics,
)
from edp.monitor.whitening import Whitening

SPECS = [DETECTORS[name]() for name in DETECTORS] + [CusumSpec(0.0), EwmaSpec(1.0), GlrSpec(1), GlrSpec(7)]
IDS = [str(spec) for spec in SPECS]
LISTED = {DETECTORS[name] for name in DETECTORS}


def plain_cusum(rows, spec):
    total, out = np.zeros(rows.shape[1]), []
    for x in rows:
        length = math.sqrt(((total + x) ** 2).sum())
        total = np.zeros_like(total) if length <= spec.slack else (total + x) * (1 - spec.slack / length)
        out.append(math.sqrt((total**2).sum()))
    return out


def plain_ewma(rows, spec):
    ages = np.arange(len(rows))[:, None] - np.arange(len(rows))
    weights = np.where(ages >= 0, spec.weight * (1 - spec.weight) ** np.maximum(ages, 0), 0.0)
    return ((weights @ rows) ** 2).sum(axis=1) / (spec.weight / (2 - spec.weight))


def plain_glr(rows, spec):
    tails = [[rows[j : t + 1] for j in range(max(0, t + 1 - spec.window), t + 1)] for t in range(len(rows))]
    return [max((tail.sum(axis=0) ** 2).sum() / (2 * len(tail)) for tail in each) for each in tails]


def plain_e_detector(rows, spec):
    out = []
    for t in range(len(rows)):
        members = []
        for shift in (sign * size for size in spec.shifts for sign in (1, -1)):
            for x in rows[: t + 1].T:
                # A bet from every row on, and the sum of all of them.
                bets = np.exp(shift * x - shift**2 / 2)
                members.append(sum(np.prod(bets[first:]) for first in range(t + 1)))
        out.append(math.log(np.mean(members)))
    return out


def plain_separate_cusums(rows, spec):
    # From every row on: the sum since then, less the slack a row; the largest of all, to both sides.
    sums = [
        [(side * rows[j : t + 1] - spec.slack).sum(axis=0) for side in (1, -1) for j in range(t + 1)]
        for t in range(len(rows))
    ]
    return [max(0.0, np.max(each)) for each in sums]


PLAIN = {
    SeparateCusumsSpec: plain_separate_cusums,
    CusumSpec: plain_cusum,
    EwmaSpec: plain_ewma,
    GlrSpec: plain_glr,
    EDetectorSpec: plain_e_detector,
}


def white(seed, *shape):
    return np.random.default_rng(seed).normal(size=shape)


def run_lengths(spec, channels, limit, lanes=1500, most=8000, shift=0.0, seed=0):
    """Rows to the first alarm of many streams of white residuals, the first of which is shifted."""
    rng, detector = np.random.default_rng(seed), spec.build(channels, lanes)
    lengths, running = np.full(lanes, most), np.ones(lanes, dtype=bool)
    for row in range(1, most + 1):
        residuals = rng.normal(size=(lanes, channels))
        residuals[:, 0] += shift
        first = running & (detector.step(residuals) > limit)
        lengths[first], running = row, running & ~first
        if not running.any():
            break
    return lengths


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_a_stream_gives_what_the_plain_form_gives_of_the_whole(spec):
    rows = white(1, 60, 3)
    rows[30:, 1] += 1.5
    np.testing.assert_allclose(statistics(spec.build(3), rows[:, None])[:, 0], PLAIN[type(spec)](rows, spec), rtol=1e-9)


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_streams_side_by_side_do_not_know_each_other(spec):
    sessions = white(2, 200, 5, 2)
    together = statistics(spec.build(2, 5), sessions)
    for lane in range(5):
        np.testing.assert_array_equal(together[:, lane], statistics(spec.build(2), sessions[:, lane : lane + 1])[:, 0])
    detector = spec.build(2, 5)
    for rows in sessions[:50]:
        detector.step(rows)
    detector.reset(np.arange(5) == 3)
    np.testing.assert_array_equal(detector.step(sessions[0])[3], together[0, 3])
    # The others go on, but for detectors without a memory.
    differ = np.delete(detector.step(sessions[1]), 3) != np.delete(together[1], 3)
    assert differ.any() != (spec in (EwmaSpec(1.0), GlrSpec(1)))


@pytest.mark.parametrize("spec", SPECS, ids=IDS)
def test_what_is_missing_says_nothing_and_what_does_not_fit_is_refused(spec):
    rows = white(3, 40, 1, 3)
    gone, zero = rows.copy(), rows.copy()
    gone[10:20, 0, 1], gone[25, 0, 2], zero[10:20, 0, 1], zero[25, 0, 2] = np.nan, np.inf, 0.0, 0.0
    values = statistics(spec.build(3), gone)
    assert np.isfinite(values).all()
    np.testing.assert_array_equal(values, statistics(spec.build(3), zero))
    with pytest.raises(DataError, match=r"shape \(1, 3\) must hold"):
        spec.build(3).step(np.zeros(3))


@pytest.mark.long
@pytest.mark.parametrize("spec", SPECS[: len(LISTED)], ids=IDS[: len(LISTED)])
def test_a_larger_shift_is_seen_sooner_and_an_endless_one_stays_a_number(spec):
    limit = np.quantile(statistics(spec.build(2, 300), white(4, 300, 300, 2)).max(axis=0), 0.9)
    delays = [np.median(run_lengths(spec, 2, limit, 200, 2000, shift)) for shift in (0.0, 0.5, 1.0, 3.0)]
    assert delays == sorted(delays, reverse=True)
    assert delays[3] < delays[1] / 4
    assert np.isfinite(statistics(spec.build(1), np.full((500, 1, 1), 100.0))).all()


@pytest.mark.parametrize(
    ("spec", "channels", "limit", "length"),
    [
        # Crosier 1988; Lowry, Woodall, Champ and Rigdon 1992; Lucas and Saccucci 1990.
        (CusumSpec(0.5), 2, 5.50, 200.0),
        (CusumSpec(0.5), 5, 9.46, 200.0),
        (EwmaSpec(0.1), 2, 8.64, 200.0),
        (EwmaSpec(0.1), 1, 2.814**2, 500.0),
        # One row alone: exact.
        (EwmaSpec(1.0), 3, chi2.isf(1 / 150, 3), 150.0),
        (GlrSpec(1), 3, chi2.isf(1 / 150, 3) / 2, 150.0),
    ],
)
def test_mean_run_lengths_are_those_that_were_published(spec, channels, limit, length):
    lengths = run_lengths(spec, channels, limit)
    # Four standard errors of a geometric length, and two digits of the limits.
    assert lengths.mean() == pytest.approx(length, rel=4 / math.sqrt(len(lengths)) + 0.03)


def test_a_shift_of_one_is_seen_after_the_published_time():
    """Crosier 1988: 9.35 rows for two residuals at a limit of 200 rows."""
    assert run_lengths(CusumSpec(0.5), 2, 5.50, shift=1.0).mean() == pytest.approx(9.35, rel=0.05)


def test_the_e_process_less_the_rows_is_a_martingale_and_its_limit_a_run_length():
    spec = EDetectorSpec((0.2, 0.4))
    values = np.exp(statistics(spec.build(2, 4000), white(5, 30, 4000, 2)))
    np.testing.assert_allclose(values.mean(axis=1), np.arange(1, 31), rtol=0.05)
    assert run_lengths(EDetectorSpec(), 2, math.log(100.0), 600, 4000).mean() > 100.0


def test_alarms_reset_their_stream_alone():
    sessions = np.zeros((30, 2, 1))
    sessions[10:, 1] = 1.0
    raised = alarms(CusumSpec(0.5).build(1, 2), sessions, 1.9)
    # 0.5 a row: the limit is passed by the fourth, again and again.
    assert [(alarm.row, alarm.lane) for alarm in raised] == [(row, 1) for row in (13, 17, 21, 25, 29)]
    assert raised[0].statistic == 2.0
    assert len(alarms(CusumSpec(0.5).build(1, 2), sessions, np.array([1.9, 9.9]))) == 1


def sessions_of(seed, count=8, rows=300, channels=2):
    return list(white(seed, count, rows, channels))


@pytest.mark.parametrize("spec", SPECS[: len(LISTED)], ids=IDS[: len(LISTED)])
def test_a_limit_is_the_lowest_that_keeps_the_promise(spec):
    sessions = sessions_of(6)
    hours = 8 * 300 / 3600
    limit = calibrated(spec, sessions, 1.0, hours / 5)
    count = sum(len(alarms(spec.build(2), session[:, None], limit.limit)) for session in sessions)
    # One fewer than five: the lowest limit with four has five on new sessions.
    assert count == limit.alarms <= 4
    assert limit.hours == pytest.approx(hours)
    assert limit.low_hours < hours / max(count, 1) < limit.high_hours
    lower = limit.limit - 1e-3 * abs(limit.limit)
    assert sum(len(alarms(spec.build(2), session[:, None], lower)) for session in sessions) > 4
    assert f"{count_of(count, 'false alarm')} in 0.667 h" in limit.sentence()


def test_hours_that_are_no_multiple_of_the_promise_lie_between():
    """Of 2.5 alarms that are allowed, half the way from the limit of two to that of three."""
    sessions, hours = sessions_of(6), 8 * 300 / 3600
    two, half, three = (calibrated(CusumSpec(), sessions, 1.0, hours / n) for n in (2.0, 2.5, 3.0))
    assert three.limit < half.limit < two.limit
    assert half.limit == pytest.approx(0.5 * (two.limit + three.limit), rel=1e-3)
    count = sum(len(alarms(CusumSpec().build(2), session[:, None], half.limit)) for session in sessions)
    assert count == half.alarms


@pytest.mark.long
def test_promise_and_interval_hold_on_other_sessions():
    """Rates of ten limits on fresh sessions, long enough to be nearly exact."""
    inside, ratios, promise = 0, [], 0.06
    for seed in range(10):
        limit = calibrated(CusumSpec(), sessions_of(100 + seed), 1.0, promise)
        fresh = white(200 + seed, 300, 400, 2)
        hours = 300 * 400 / 3600 / max(1, len(alarms(CusumSpec().build(2, 400), fresh, limit.limit)))
        inside += limit.low_hours <= hours <= limit.high_hours
        ratios.append(hours / promise)
    assert inside >= 8
    assert 3 / 4 < np.median(ratios) < 4 / 3


def test_too_few_hours_name_what_they_support():
    with pytest.raises(ConfigError, match=r"0\.667 h of healthy .* too few.*support one in 0\.667 h: .*7\.33 h more"):
        calibrated(CusumSpec(), sessions_of(1), 1.0, 8.0)
    for rate, promise in ((0.0, 1.0), (math.nan, 1.0), (1.0, -1.0), (1.0, math.inf)):
        with pytest.raises(ConfigError, match="must hold"):
            calibrated(CusumSpec(), sessions_of(1), rate, promise)
    for sessions in ([], [np.zeros((5, 2)), np.zeros((5, 3))], [np.zeros(5)]):
        with pytest.raises(DataError, match="of one width"):
            calibrated(CusumSpec(), sessions, 1.0, 1.0)


def test_hours_between_alarms_are_those_of_garwood():
    """Exact limits of a Poisson mean at 95 %: 0 to 3.689, 0.0253 to 5.572, 4.795 to 18.39."""
    for count, low, high in ((0, 0.0, 3.689), (1, 0.02532, 5.572), (10, 4.795, 18.39)):
        least, most = hours_between(count, 100.0)
        assert 100.0 / least == pytest.approx(high, rel=1e-3)
        assert (100.0 / most if most < math.inf else 0.0) == pytest.approx(low, rel=1e-3)


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: CusumSpec(-1.0), "0 <= slack"),
        (lambda: EwmaSpec(0.0), "0 < weight <= 1"),
        (lambda: GlrSpec(0), "1 <= window"),
        (lambda: EDetectorSpec(()), "1 to 20 must hold"),
        (lambda: EDetectorSpec((1.0, 1.0)), "name each once"),
        (lambda: EDetectorSpec((math.nan,)), "0 < shifts"),
    ],
)
def test_options_out_of_their_bounds_are_refused(build, words):
    with pytest.raises(ConfigError, match=words):
        build()


def test_whitening_makes_residuals_standard_and_drops_what_does_not_vary():
    rng = np.random.default_rng(0)
    base = rng.normal(size=(4000, 3)) @ np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 1.0]])
    rows = np.column_stack((base * [1e-3, 1e5, 1.0] + [1.0, -2e5, 0.0], base[:, 0] * 7e-3, np.full(4000, 4.0)))
    rows[5, 0] = np.nan
    whitening = Whitening.fit([rows[:1500], rows[1500:]])
    shown = whitening(np.delete(rows, 5, axis=0))
    assert shown.shape == (3999, 3)
    np.testing.assert_allclose(shown.mean(axis=0), 0.0, atol=1e-9)
    np.testing.assert_allclose(np.cov(shown, rowvar=False), np.eye(3), atol=1e-6)
    assert np.isfinite(whitening(rows)).all()
    with pytest.raises(DataError, match="too few for their covariance"):
        Whitening.fit([rows[:3]])
    with pytest.raises(DataError, match="too few"):
        Whitening.fit([])
    with pytest.raises(DataError, match="do not vary"):
        Whitening.fit([np.ones((50, 2))])


def test_every_detector_has_a_plain_form():
    assert set(PLAIN) == LISTED
