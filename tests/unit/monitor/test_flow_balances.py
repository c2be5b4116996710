"""Balances of flow: spools and curves from logs, rests where a valve or a sensor is wrong, streaming, files."""

from dataclasses import asdict

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.monitor.residuals import RESIDUALS, FitMaterial
from edp.monitor.residuals.base import SourceParts, residuals_of
from edp.monitor.residuals.flow_balances import FlowBalances, FlowBalancesSpec
from edp.monitor.residuals.flow_curves import KNOTS, hats, opened, played
from edp.monitor.residuals.groups import select_sensed
from edp.recording import Recording
from edp.sim import Scenario, simulate
from edp.wording import figure

pytestmark = pytest.mark.long

SPEC = FlowBalancesSpec(trials=40, rows=20_000)


def session(seed, faults=(), seconds=40.0):
    return simulate(Scenario(duration_s=seconds, seed=seed, excitation="aprbs", faults=list(faults)))


def material(sessions):
    return FitMaterial(sessions[:-1], sessions[-1:], select_sensed(sessions[0].channels), sessions[0].rate_hz)


@pytest.fixture(scope="module")
def source():
    return SPEC.fit(material([session(seed) for seed in range(8)]))


def test_every_chamber_has_a_balance_and_its_spools_are_those_of_the_machine(source):
    assert source.names == tuple(f"flow:CylPressures_{n}" for n in (1, 5, 2, 6, 3, 7))
    assert source.judged[:3] == (("CylVels_1",), ("CylVels_1",), ("CylVels_2",))
    assert {"PumpPressure_2", "BmUpConf", "CylStroke_1"} <= {*source.reads[0]}
    assert "AmIn" not in source.reads[0]
    # M22: 40 ms on the bus, 6 to 8 Hz in both stages, play of 0.012 of the travel.
    assert (np.abs(source.spools.dead[::2] - 4.0) < 2.0).all()
    assert (np.abs(source.spools.play - 0.012) < 0.006).all()


def rest(source, recording, axis):
    rows = residuals_of(source, [recording])[0][500:]
    return np.abs(rows[:, [i for i, judged in enumerate(source.judged) if judged == (axis,)]]).mean()


@pytest.mark.parametrize(
    ("fault", "axis"),
    [
        ("stuck_spool:arm:80%@0s", "CylVels_2"),
        ("dead_band:bucket:16%@0s", "CylVels_3"),
        ("velocity_scale:boom:10%@0s", "CylVels_1"),
        ("internal_leak:bucket:10L/min@0s", "CylVels_3"),
    ],
)
def test_a_fault_of_valve_seal_or_sensor_leaves_a_rest(source, fault, axis):
    healthy, faulty = session(100), session(100, [fault])
    assert rest(source, faulty, axis) > 1.5 * rest(source, healthy, axis)


def test_a_healthy_rest_is_about_its_width_and_a_small_part_of_the_velocity(source):
    recording = session(101)
    for axis in ("CylVels_1", "CylVels_2", "CylVels_3"):
        assert 0.2 < rest(source, recording, axis) < 2.0
        velocity = np.abs(recording.column(axis)).mean()
        usual = [float(c.doubts[0]) for c, judged in zip(source.chambers, source.judged, strict=True) if axis in judged]
        assert max(usual) < 0.05 * velocity


def test_ticks_and_chunks_are_one_run_and_a_file_brings_it_back(source):
    rows = session(102, seconds=6.0).select(source.inputs)[None]
    whole, _ = source.run(rows, source.initial_state(1))
    again = FlowBalances.from_parts(source.parts())
    state, pieces = again.initial_state(1), []
    for piece in np.split(rows, [1, 2, 3, 50, 333], axis=1):
        out, state = again.run(piece, state)
        pieces.append(out)
    np.testing.assert_array_equal(np.concatenate(pieces, axis=1), whole)
    rows[0, 300, source.inputs.index("AmIn")] = np.nan
    gone, _ = source.run(rows, source.initial_state(1))
    assert np.isnan(gone[0, 300]).tolist() == ["CylVels_2" in judged for judged in source.judged]
    assert np.isfinite(gone[0, 301:]).all()


def test_oil_that_was_not_learned_silences_them_and_is_said(source):
    recording = session(102, seconds=6.0)
    column = recording.channel_names.index("OilTemperature")
    values = recording.values.copy()
    values[200:, column] = source.oil.high + 0.5
    hot = Recording("hot", recording.channels, values, recording.rate_hz)
    rows = residuals_of(source, [hot])[0]
    assert np.isfinite(rows[:200]).all()
    assert np.isnan(rows[200:]).all()
    assert "67 %" in source.unlearned(hot)
    assert "OilTemperature" in source.unlearned(hot)
    assert f"to {figure(source.oil.high - 273.15)} degC" in source.unlearned(hot)
    assert source.unlearned(recording) == ""
    # A thermometer that fails is no reason to be blind.
    values[:, column] = np.nan
    gone = Recording("gone", recording.channels, values, recording.rate_hz)
    assert np.isfinite(residuals_of(source, [gone])[0]).all()


def test_sisters_scatter_about_the_machine_by_their_tolerance(source):
    rows = session(103, seconds=20.0).select(source.inputs)[None]
    own, _ = source.run(rows, source.initial_state(1))

    def apart(tolerance):
        sisters = [source.adjust_to_sister(np.random.default_rng(seed), tolerance) for seed in range(4)]
        return np.mean([np.abs(one.run(rows, one.initial_state(1))[0] - own).mean() for one in sisters])

    near, far = apart(0.01), apart(0.03)
    assert 0.0 < near < 0.5 * far
    assert source.oil == source.adjust_to_sister(np.random.default_rng(0), 0.01).oil


def test_a_damaged_file_is_refused(source):
    parts = source.parts()
    entry = dict(parts.plain["chambers"][0])
    for change in ({"velocity": 99}, {"spools": [7]}, {"sign": 2}, {"cushion": 0.0}, {"supplies": [0] * 9}):
        plain = dict(parts.plain) | {"chambers": [entry | change]}
        with pytest.raises(ValueError, match="chamber"):
            FlowBalances.from_parts(SourceParts(plain, parts.arrays))
    for name, values in (("spools.dead", [1e9] * 6), ("spools.extend", [99] * 6), ("0.values", [[np.nan]])):
        with pytest.raises(ValueError, match=rf"'{name.split('.')[1]}': got .*, expected"):
            FlowBalances.from_parts(SourceParts(parts.plain, dict(parts.arrays) | {name: np.array(values)}))
    with pytest.raises(ValueError, match="rate"):
        FlowBalances.from_parts(SourceParts(dict(parts.plain) | {"rate_hz": -1.0}, parts.arrays))
    for change in ({"column": 99}, {"low": float("nan")}, {"low": 90.0, "high": 80.0}):
        oil = parts.plain["oil"] | change
        with pytest.raises(ValueError, match=r"thermometer|temperatures"):
            FlowBalances.from_parts(SourceParts(dict(parts.plain) | {"oil": oil}, parts.arrays))


def test_a_machine_without_pressures_has_none():
    sessions = [session(seed, seconds=5.0) for seed in range(2)]
    few = [one for one in select_sensed(sessions[0].channels) if not one.name.startswith("CylPressures")]
    assert SPEC.fit(FitMaterial(sessions[:1], sessions[1:], tuple(few), sessions[0].rate_hz)) is None


def test_play_of_many_ticks_at_once_is_that_of_one_after_the_other():
    values = np.cumsum(np.random.default_rng(0).normal(size=(2, 300)), axis=1).astype(np.float32)
    width, held = np.float32(0.7), np.array([0.1, -3.0], np.float32)
    out, last = played(values, width, held)
    for tick in range(values.shape[1]):
        held = np.maximum(values[:, tick] - width, np.minimum(values[:, tick] + width, held))
        np.testing.assert_array_equal(out[:, tick], held)
    np.testing.assert_array_equal(last, held)


def test_a_curve_is_the_sum_of_its_hats():
    heights = np.random.default_rng(1).normal(size=len(KNOTS) - 1)
    values = np.concatenate([[0.0], heights]).astype(np.float32)
    slopes = np.append(np.diff(values.astype(float)) / np.diff(KNOTS.astype(float)), 0.0).astype(np.float32)
    travel = np.linspace(0.0, 1.4, 100, dtype=np.float32)
    np.testing.assert_allclose(opened(travel, values, slopes), hats(travel) @ heights, atol=1e-5)


def test_options_are_bounded_and_registered():
    assert RESIDUALS["flow_balances"] is FlowBalancesSpec
    assert asdict(SPEC)["min_explained"] == 0.6
    for change in ({"rows": 10}, {"trials": 0}, {"min_explained": 2.0}):
        with pytest.raises(ConfigError, match="flow_balances"):
            FlowBalancesSpec(**change)
