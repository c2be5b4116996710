"""What every registered source of residuals keeps: streaming, silence of what is missing, and its files."""

import numpy as np
import pytest

from edp.data.features import FeatureSet
from edp.data.scaling import fit_scaler
from edp.data.task import TargetMode, Task
from edp.data.twin_channels import twin_channels
from edp.monitor.residuals import RESIDUALS, FitMaterial, ResidualSource
from edp.networks.backbones import HybridSpec
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.twin import fit_scales
from edp.networks.twin.arx import Arx
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.testing.monitor import rig_sessions
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle

TICKS = 400


@pytest.fixture(scope="module")
def sessions() -> list[Recording]:
    return rig_sessions(6, TICKS, seed=3)


@pytest.fixture(scope="module", params=list(RESIDUALS))
def source(request, sessions) -> ResidualSource:
    material = FitMaterial(
        sessions[:4],
        sessions[4:5],
        sessions[0].channels,
        100.0,
        predictors=(look_ahead(sessions),),
        twins=(twin(sessions),),
        minutes=0.02,
    )
    fitted = RESIDUALS[request.param]().fit(material)
    assert fitted is not None, "the rig offers something to every source"
    return fitted


def look_ahead(sessions: list[Recording]) -> Bundle:
    """A network with drawn weights: what a source does with it does not depend on how good it is."""
    task = Task(FeatureSet("all", sessions[0].channel_names), ("velocity",), (1, 5), TargetMode.DELTA, 100.0)
    series = [task.series(session) for session in sessions]
    scaler = fit_scaler(task, series, tuple(channel.kind for channel in sessions[0].channels))
    spec = ModelSpec(backbone=HybridSpec(channels=(4,), kernel=3, units=4), head=MlpHead(hidden=4, layers=1), window=8)
    predictor = build_model(task, spec, scaler, 0).eval()
    return Bundle(predictor, sessions[0].channels, (Kind.VELOCITY,), ("",))


def twin(sessions: list[Recording]) -> TwinBundle:
    channels = twin_channels(sessions[0])
    series = [channels.task().series(session) for session in sessions]
    return TwinBundle(Arx(), Arx().start(channels, fit_scales(channels, series), series, 0))


def rows_of(source: ResidualSource, recordings) -> np.ndarray:
    return np.stack([recording.select(source.inputs) for recording in recordings])


@pytest.mark.long
def test_ticks_chunks_and_one_call_agree(source, sessions):
    rows = rows_of(source, sessions[:2])[:, :150]
    whole, _ = source.run(rows, source.initial_state(2))
    for length in (1, 37):
        state, parts = source.initial_state(2), []
        for start in range(0, rows.shape[1], length):
            part, state = source.run(rows[:, start : start + length], state)
            parts.append(part)
        scale = np.nanmax(np.abs(whole), axis=(0, 1))
        np.testing.assert_allclose(np.concatenate(parts, axis=1) / scale, whole / scale, atol=2e-4)


@pytest.mark.long
def test_a_missing_channel_silences_what_reads_it_and_spoils_nothing(source, sessions):
    rows = rows_of(source, sessions[:1])
    gone = rows.copy()
    gone[:, 50:60, 0] = np.nan
    residuals, _ = source.run(gone, source.initial_state(1))
    silent = np.array([source.inputs[0] in reads for reads in source.reads])
    assert np.isnan(residuals[0, 50:60][:, silent]).all()
    assert np.isfinite(residuals[0, 50:60][:, ~silent]).all()
    assert np.isfinite(residuals[0, 60:]).all()
    # Ticks, too: what stands in for the missing value is part of the state.
    state, ticks = source.initial_state(1), []
    for tick in gone[0]:
        one, state = source.run(tick[None, None], state)
        ticks.append(one[0])
    np.testing.assert_array_equal(np.isnan(np.concatenate(ticks)), np.isnan(residuals[0]))


def test_missing_from_the_start(source, sessions):
    rows = rows_of(source, sessions[:1])
    rows[:, :, 0] = np.nan
    residuals, _ = source.run(rows, source.initial_state(1))
    silent = np.array([source.inputs[0] in reads for reads in source.reads])
    assert np.isnan(residuals[..., silent]).all()
    assert np.isfinite(residuals[..., ~silent]).all()


def test_facts_have_one_entry_a_residual(source):
    assert len(source.names) == len(source.judged) == len(source.reads) == len(source.units)
    assert len(set(source.names)) == len(source.names)
    assert all({*judged} <= {*reads} for judged, reads in zip(source.judged, source.reads, strict=True))


def test_a_bias_of_what_is_judged_shows(source, sessions):
    """Measured less expected: an offset of the channel moves its residual to its side, `delay` ticks later."""
    rows = rows_of(source, sessions[:1])
    before, _ = source.run(rows, source.initial_state(1))
    for place, judged in enumerate(source.judged):
        column = source.inputs.index(judged[0])
        moved = rows.copy()
        moved[:, TICKS // 2 :, column] += 10.0 * rows[..., column].std()
        after, _ = source.run(moved, source.initial_state(1))
        moved_by = np.nan_to_num((after - before)[0, :, place])
        soon = moved_by[TICKS // 2 :][: source.delay + 1]
        assert soon[np.flatnonzero(soon)[:1]].sum() > 0.0, source.names[place]
        # Not before it happened, and a source that promises to be late is late.
        assert not moved_by[: TICKS // 2 + source.delay].any(), source.names[place]


def test_a_source_of_a_sister_reads_and_judges_the_same(source, sessions):
    rows = rows_of(source, sessions[:1])
    other = source.adjust_to_sister(np.random.default_rng(0), 0.02)
    assert (other.names, other.reads, other.inputs, other.delay) == (
        source.names,
        source.reads,
        source.inputs,
        source.delay,
    )
    residuals, _ = other.run(rows, other.initial_state(1))
    assert np.isfinite(residuals).mean() > 0.9
    own, _ = source.run(rows, source.initial_state(1))
    same, _ = source.adjust_to_sister(np.random.default_rng(0), 0.0).run(rows, source.initial_state(1))
    # Numbers that are taken apart and put together again: to the last digits.
    np.testing.assert_allclose(same, own, atol=1e-3 * np.nanstd(own))


def test_parts_give_the_same_source(source, sessions):
    rows = rows_of(source, sessions[:1])
    again = type(source).from_parts(source.parts())
    assert (again.names, again.judged, again.reads, again.units, again.inputs) == (
        source.names,
        source.judged,
        source.reads,
        source.units,
        source.inputs,
    )
    expected, _ = source.run(rows, source.initial_state(1))
    given, _ = again.run(rows, again.initial_state(1))
    np.testing.assert_array_equal(given, expected)


@pytest.mark.long
def test_a_channel_of_another_kind_is_no_trap():
    """A constant channel, and one that nothing explains, must not stop a fit."""
    sessions = rig_sessions(4, TICKS, seed=5)
    extended = [
        Recording(
            s.name,
            (*s.channels, Channel("constant", Kind.GENERIC)),
            np.concatenate([s.values, np.ones((TICKS, 1), np.float32)], axis=1),
            s.rate_hz,
        )
        for s in sessions
    ]
    material = FitMaterial(extended[:3], extended[3:], extended[0].channels, 100.0, minutes=0.02)
    for spec in RESIDUALS.values():
        fitted = spec().fit(material)
        assert fitted is None or not any("constant" in judged for judged in fitted.judged)
