"""What an adaptation learns, and that nothing makes it leave its bounds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.errors import ConfigError
from edp.ir.rls import Adaptation, AdaptationSpec, RlsCorrector, RlsState, RlsStatus
from edp.ir.rls.constants import BOUND

HARD = st.sampled_from([np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 0.0, 1.0, -1.0, 50.0])


def law(horizons=(3,), inputs=5, targets=2, **options):
    spec = AdaptationSpec(**({"rank": 2, "noise": 1.0, "evaluation_s": 2.0} | options))
    rng = np.random.default_rng(0)
    shape = (len(horizons), targets)
    arrays = {
        "offset": rng.normal(size=inputs),
        "scale": rng.uniform(0.5, 2.0, inputs),
        "directions": rng.normal(size=(spec.rank, inputs)),
        "middle": np.zeros(targets),
        "spread": np.ones(targets),
        "change": np.ones(shape),
        "unit": np.full(shape, 0.5),
    }
    held = {name: values.astype(np.float32) for name, values in arrays.items()}
    return Adaptation(spec=spec, rate_hz=100.0, horizons=horizons, columns=tuple(range(targets)), **held)


def machine(ticks, seed=0, fault=0.3, inputs=5, k=3):
    """Inputs whose first two columns are speeds; predictions that lack a share of the pilot's effect."""
    rng = np.random.default_rng(seed)
    x = np.zeros((ticks + k, inputs))
    for t in range(1, len(x)):
        x[t] = 0.95 * x[t - 1] + 0.3 * rng.normal(size=inputs)
    y = x[k:, :2] - fault * x[:-k, 3:5]
    return x[:ticks].astype(np.float32), y[:, None].astype(np.float32)


def run(adapter, x, y, **options):
    made = [adapter.step(*row, **options) for row in zip(x, y, strict=True)]
    return np.stack([m[0] for m in made]), [m[1] for m in made]


def mae(y, x, k=3):
    return np.abs(y[:-k, 0] - x[k:, :2]).mean()


def test_without_fading_it_is_ridge_regression():
    """Independent: the normal equations of all errors that have come due."""
    held = law(forgetting_s=1e6, limit=1000.0, prior=0.3)
    x, y = machine(400, fault=0.05)
    adapter = RlsCorrector(held)
    run(adapter, x, y)
    phi, error = [], []
    for t in range(3, 400):
        if t < 397:
            scaled = np.clip((x[t].astype(float) - held.offset) / held.scale, -6, 6)
            last = (x[t, :2] - y[t - 3, 0]) / 0.5
            phi.append(
                np.concatenate([[1], x[t, :2], y[t, 0] - x[t, :2], last, np.clip(held.directions @ scaled, -6, 6)])
            )
            error.append((x[t + 3, :2] - y[t, 0]) / 0.5)
    phi, error = np.array(phi)[: 400 - 6], np.array(error)
    normal = phi.T @ phi + np.eye(phi.shape[1]) / 0.3**2
    np.testing.assert_allclose(adapter.theta[0].T, np.linalg.solve(normal, phi.T @ error), atol=0.02)
    np.testing.assert_allclose(adapter.covariance[0], np.linalg.inv(normal), atol=0.02)


def test_a_step_change_is_learned_and_a_frozen_one_learns_nothing():
    x, y = machine(3000)
    adapted, status = run(RlsCorrector(law()), x, y)
    assert mae(adapted[1000:], x[1000:]) < 0.4 * mae(y[1000:], x[1000:])
    assert status.count(RlsStatus.LEARNING) > 2900
    adapter = RlsCorrector(law())
    run(adapter, x[:1000], y[:1000])
    before = adapter.theta.copy()
    frozen, status = run(adapter, x[1000:], y[1000:], learn=False)
    np.testing.assert_array_equal(adapter.theta, before)
    assert RlsStatus.LEARNING not in status
    assert mae(frozen, x[1000:]) < 0.6 * mae(y[1000:], x[1000:])


def test_what_was_learned_comes_back_and_another_ones_is_refused():
    x, y = machine(1500)
    adapter, fresh = RlsCorrector(law()), RlsCorrector(law())
    run(adapter, x, y)
    fresh.restore(adapter.learned)
    np.testing.assert_array_equal(fresh.theta, adapter.theta)
    with pytest.raises(ConfigError, match="another adaptation"):
        RlsCorrector(law(prior=0.2)).restore(adapter.learned)
    for bad in (np.nan, 1e6):
        with pytest.raises(ConfigError, match="out of its bounds"):
            fresh.restore(RlsState(adapter.learned.digest, np.full_like(adapter.theta, bad)))


def test_a_correction_that_does_harm_is_taken_back_and_returns():
    x, y = machine(6000)
    turned = y.copy()
    turned[2000:] = x[2000:, None, :2] * 2 - y[2000:]  # errors of the other sign, frozen: what was learned does harm
    adapter = RlsCorrector(law())
    run(adapter, x[:2000], y[:2000])
    made, status = run(adapter, x[2000:], turned[2000:], learn=False)
    assert status[-1] is RlsStatus.FALLBACK
    assert adapter.fallback.any()
    np.testing.assert_array_equal(made[-1][adapter.fallback], turned[-1][adapter.fallback])
    _, status = run(adapter, x[:4000], y[:4000])
    assert status[-1] is RlsStatus.LEARNING


def test_nothing_is_learned_at_rest_or_from_ticks_that_are_missing():
    x, y = machine(500)
    adapter = RlsCorrector(law())
    run(adapter, x, y)
    theta, covariance = adapter.theta.copy(), adapter.covariance.copy()
    still = np.zeros((200, 5), dtype=np.float32)
    out, status = run(adapter, still, np.full((200, 1, 2), 0.01, dtype=np.float32))
    np.testing.assert_array_equal(out, np.full((200, 1, 2), np.float32(0.01)))
    assert set(status[3:]) == {RlsStatus.HOLDING}
    adapter.theta, adapter.covariance = theta.copy(), covariance.copy()
    for tick in range(30):
        adapter.step(x[tick], y[tick], fresh=tick % 3 != 0)
    np.testing.assert_array_equal(adapter.theta, theta)
    np.testing.assert_array_equal(adapter.covariance, covariance)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.lists(st.tuples(st.integers(0, 299), st.integers(0, 6), HARD), max_size=40),
       st.sampled_from([(1,), (3,), (2, 5)]), st.floats(0.001, 100.0), st.floats(0.1, 1000.0))  # fmt: skip
def test_no_input_makes_it_leave_its_bounds(seed, faults, horizons, noise, size):
    held = law(horizons, noise=noise, forgetting_s=0.5)
    rng = np.random.default_rng(seed)
    x = (size * rng.normal(size=(300, 5))).astype(np.float32)
    y = (size * rng.normal(size=(300, len(horizons), 2))).astype(np.float32)
    for tick, place, value in faults:
        if place < 5:
            x[tick, place] = value
        else:
            y[tick, 0, place - 5] = value
    adapter, most = RlsCorrector(held), held.unit * held.numbers["limit"]
    for tick in range(300):
        out, status = adapter.step(x[tick], y[tick], fresh=tick % 97 != 0, learn=tick % 50 < 40)
        if status is RlsStatus.NONE:
            np.testing.assert_array_equal(out, y[tick])
            continue
        assert np.isfinite(out).all()
        assert (np.abs(out - y[tick]) <= most + 1e-6 * np.abs(y[tick])).all()
        assert (np.abs(adapter.theta) <= np.float32(BOUND * held.spec.prior)).all()
        diagonal = np.einsum("hii->hi", adapter.covariance)
        assert ((diagonal > 0) & (diagonal <= 1.001 * held.numbers["prior"])).all()
    assert adapter.repairs == 0


def test_standstill_and_one_direction_alone_wind_nothing_up():
    held = law(forgetting_s=1.0)
    adapter = RlsCorrector(held)
    x = np.tile(np.array([1, 0.5, 0.2, 0, 0], dtype=np.float32), (5000, 1))
    y = np.full((5000, 1, 2), 1.1, dtype=np.float32)
    run(adapter, x, y)
    values = np.linalg.eigvalsh(adapter.covariance[0].astype(float))
    assert values.min() > 0
    assert values.max() <= 1.001 * held.numbers["prior"]


def test_damaged_memory_heals():
    x, y = machine(300)
    adapter = RlsCorrector(law())
    run(adapter, x[:100], y[:100])
    adapter.theta[0, 0, 0], adapter.covariance[0, 1, 1] = np.nan, -1e3
    out, _ = run(adapter, x[100:], y[100:])
    assert np.isfinite(out).all()
    assert np.isfinite(adapter.theta).all()
    assert adapter.repairs >= 1


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"scale": np.zeros(5, dtype=np.float32)}, "not positive"),
        ({"directions": np.zeros((3, 5), dtype=np.float32)}, "shape"),
        ({"offset": np.full(5, np.nan, dtype=np.float32)}, "finite"),
        ({"horizons": (0,)}, "at least 1"),
    ],
)
def test_constants_that_cannot_be_are_refused(change, reason):
    with pytest.raises(ConfigError, match=reason):
        replace(law(), **change)


@pytest.mark.parametrize("options", [{"rank": 65}, {"noise": 0.0}, {"forgetting_s": np.inf}, {"dead_zone": -1.0}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match=next(iter(options))):
        AdaptationSpec(**options)


def test_plain_values_and_arrays_give_the_same_adaptation():
    held = law((2, 5))
    again = Adaptation.from_dict(held.to_dict(), held.arrays())
    assert again.digest == held.digest
    assert replace(held, rate_hz=50.0).digest != held.digest


def test_the_digest_stays_from_version_to_version():
    """A state that a controller saved bears it; the number is that of the version before bundles of schema 8."""
    names = {"offset": 2, "scale": 2, "directions": (1, 2), "middle": 1, "spread": 1, "change": (1, 1), "unit": (1, 1)}
    halves = {name: np.full(shape, 0.5, dtype=np.float32) for name, shape in names.items()}
    adaptation = Adaptation(spec=AdaptationSpec(rank=1), rate_hz=100.0, horizons=(3,), columns=(0,), **halves)
    assert adaptation.digest == "885583896a91c3a2d884207efe9c5b9e"
