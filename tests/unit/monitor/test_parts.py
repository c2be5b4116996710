"""Parts of the chain by themselves: drift, conditioning, views, the look-ahead network of the monitor's own."""

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.monitor.adaptation import SlowDrift
from edp.monitor.conditioning import fit_conditioning
from edp.monitor.detectors import CusumSpec, SeparateCusumsSpec
from edp.monitor.residuals import FitMaterial
from edp.monitor.residuals.balances import BalancesSpec
from edp.monitor.residuals.base import residuals_of
from edp.monitor.residuals.look_ahead import LookAheadSpec
from edp.monitor.watches import MIN_GROSS, BankSpec, WatchSpec, fit_watch, scale_watches
from edp.recording import Recording
from edp.signals import VOCABULARY
from edp.testing.monitor import rig_sessions


def test_drift_follows_what_is_slow_and_is_bounded():
    drift = SlowDrift(step=0.01, most=0.5)
    rows = np.full((200, 2), 5.0)
    rows[:, 1] = np.nan
    left, offset = drift.run(rows, np.zeros(2))
    # A fault of 5 deviations loses the bound at most, and never faster than the step.
    assert left[50, 0] == pytest.approx(5.0 - 50 * 0.01)
    assert offset.tolist() == pytest.approx([0.5, 0.0])
    halves = drift.run(rows[:77], np.zeros(2))
    again, end = drift.run(rows[77:], halves[1])
    np.testing.assert_array_equal(np.concatenate([halves[0], again]), left)
    np.testing.assert_array_equal(end, offset)


def test_conditioning_takes_off_what_goes_with_the_operating_point():
    rng = np.random.default_rng(0)
    levels = rng.normal(size=(4000, 1))
    points = np.concatenate([np.ones((4000, 1)), levels], axis=1)
    summaries = 3.0 + 2.0 * levels + (0.2 + 0.1 * np.abs(levels)) * rng.normal(size=(4000, 1))
    summaries[::50] += 100.0  # a fault in some healthy rows
    conditioning = fit_conditioning([summaries[:2000]], [points[:2000]], clip=6.0)
    z = conditioning(summaries[2001:], points[2001:])[:, 0]
    sound = np.abs(z) < 6.0
    assert abs(np.corrcoef(z[sound], levels[2001:, 0][sound])[0, 1]) < 0.1
    assert 0.7 < z[sound].std() < 1.5


@pytest.mark.parametrize("view", ["white", "adjusted"])
def test_a_view_of_averages_makes_them_of_one_size(view):
    rng = np.random.default_rng(1)
    mixing = rng.normal(size=(4, 4))
    sessions = [rng.normal(size=(600, 4)) @ mixing for _ in range(8)]
    spec = WatchSpec(detector=CusumSpec(), memory_s=5.0, shrink=0.0, view=view)
    watch = fit_watch(spec, sessions, 1.0, 0)
    rows = np.concatenate([watch(session) for session in sessions])
    np.testing.assert_allclose(rows.std(axis=0), 1.0, atol=0.15)
    if view == "white":
        np.testing.assert_allclose(np.corrcoef(rows, rowvar=False), np.eye(4), atol=0.15)


def test_an_unknown_view_is_refused():
    with pytest.raises(ConfigError, match="white, adjusted"):
        WatchSpec(detector=CusumSpec(), view="blurred")


def test_a_view_of_what_is_gross_measures_each_summary_by_itself():
    rng = np.random.default_rng(4)
    # The second summary has rare large values on healthy machines, too.
    sessions = [np.stack([rng.normal(size=500), rng.standard_t(2.0, size=500)], axis=1) for _ in range(12)]
    spec = WatchSpec(detector=SeparateCusumsSpec(), view="own")
    watch = fit_watch(spec, sessions, 1.0, 0)
    largest = np.sort([np.abs(session).max(axis=0) for session in sessions], axis=0)[-3]
    np.testing.assert_allclose(1.0 / watch.matrix, np.maximum(largest, MIN_GROSS), rtol=1e-6)
    gross = np.array([[40.0, 0.0], [np.nan, 40.0]])
    seen = BankSpec((watch,)).white(np.clip(gross, -6.0, 6.0), gross)
    np.testing.assert_allclose(seen, np.nan_to_num(gross) * watch.matrix, rtol=1e-6)
    assert seen[0, 0] > 8.0 > 4.0 > seen[1, 1]


def test_a_reserve_keeps_a_view_away_from_the_limit():
    rng = np.random.default_rng(5)
    sessions = list(rng.normal(size=(6, 100, 2)))
    specs = [WatchSpec(detector=CusumSpec(), reserve=reserve) for reserve in (1.0, 1.5)]
    watch = fit_watch(specs[0], sessions, 1.0, 0)
    near, far = scale_watches(specs, [watch, watch], [np.tile(watch(rows), 2) for rows in sessions])
    assert far.scale == pytest.approx(1.5 * near.scale)


def test_a_temperature_that_jumps_is_seen_and_a_slow_one_is_not():
    ticks = np.arange(6000)
    rng = np.random.default_rng(6)
    channels = (VOCABULARY["OilTemperature"], VOCABULARY["CylVels_1"])
    values = np.stack([310.0 + ticks / 1000 + 0.1 * rng.normal(size=6000), rng.normal(size=6000)], axis=1)
    sessions = [Recording(f"s{i}", channels, values.astype(np.float32), 100.0) for i in range(2)]
    source = BalancesSpec().fit(FitMaterial(sessions[:1], sessions[1:], channels, 100.0))
    assert source.names == ("balance:OilTemperature:10s",)
    assert source.judged == (("OilTemperature",),)
    rows = values[:, :1].astype(np.float32)
    rows[3000:] += 5.0
    residual = source.run(rows[None], source.initial_state(1))[0][0, :, 0]
    # A rise of 6 K a minute stays below 1 K of ten seconds, a jump of 5 K is there at once and fades.
    assert abs(residual[2000:3000].mean()) < 1.2
    assert residual[3000:3010].mean() > 5.0
    assert residual[5990:].mean() < 2.0


@pytest.mark.long
def test_without_a_run_a_look_ahead_network_is_trained():
    sessions = rig_sessions(5, 800, seed=2)
    material = FitMaterial(sessions[:4], sessions[4:], sessions[0].channels, 100.0, minutes=0.02)
    source = LookAheadSpec().fit(material)
    assert {name.rpartition(":")[2] for name in source.names} == {"1", "10"}
    assert {judged[0] for judged in source.judged} == {"velocity", "pressure_a", "pressure_b"}
    (residuals,) = residuals_of(source, sessions[4:])
    one = residuals[100:, source.names.index("ahead:velocity:1")]
    changes = np.diff(sessions[4].column("velocity")[99:])
    assert one.std() < 1.1 * changes.std()
    assert np.isnan(residuals[:10, source.names.index("ahead:velocity:10")]).all()


def test_a_step_of_a_stroke_stays_visible_for_the_memory_of_a_balance():
    sessions = rig_sessions(3, 1500, seed=3)
    material = FitMaterial(sessions[:2], sessions[2:], sessions[0].channels, 100.0)
    source = BalancesSpec(memory_s=(2.0,)).fit(material)
    rows = sessions[2].select(source.inputs).copy()
    before, _ = source.run(rows[None], source.initial_state(1))
    rows[700:, source.inputs.index("stroke")] += 0.05
    after, _ = source.run(rows[None], source.initial_state(1))
    moved = (after - before)[0, :, source.names.index("balance:stroke-velocity:2s")]
    np.testing.assert_allclose(moved[[699, 700, 900]], [0.0, 0.05, 0.05 * (1 - 1 / 200) ** 200], atol=1e-4)
