"""Cycles: what lies at the wrong place of a cycle is seen there, and nowhere else."""

import numpy as np
import pytest

from edp.errors import DataError
from edp.monitor.residuals.base import FitMaterial, SourceParts
from edp.monitor.residuals.cycles import Cycles, CyclesSpec
from edp.recording import Recording
from edp.signals import Channel, Kind

CHANNELS = (Channel("valve", Kind.RATIO, "valve"), Channel("pressure", Kind.PRESSURE, "pump"))
TICKS, CYCLES = 40, 6


def log(seed: int, late: int = 0) -> Recording:
    """Six cycles in which a valve opens at tick 10 and closes at 30, and the pressure answers after `late` ticks."""
    rng = np.random.default_rng(seed)
    place = np.arange(TICKS * CYCLES) % TICKS
    valve = ((place >= 10) & (place < 30)).astype(float)
    pressure = 1e7 + 5e6 * np.roll(valve, late) + 1e5 * rng.normal(size=len(place))
    return Recording(f"log_{seed}", CHANNELS, np.stack([valve, pressure], axis=1).astype(np.float32), 10.0)


def material(*logs: Recording) -> FitMaterial:
    return FitMaterial(logs, (), CHANNELS, 10.0)


@pytest.fixture(scope="module")
def source():
    return CyclesSpec(period_s=4.0).fit(material(log(0), log(1)))


def test_a_valve_that_switches_late_shows_in_the_tick_behind_its_command(source):
    assert source.names == ("cycle:valve", "cycle:pressure")
    for late in (0, 1):
        residuals, _ = source.run(log(7, late).select(source.inputs)[None], source.initial_state(1))
        size = np.abs(residuals[0, :, 1]).reshape(CYCLES, TICKS)
        switching = size[1:, [10, 30]]
        assert (switching.min() > 10.0) if late else (switching.max() < 5.0)
        assert np.delete(size, [10, 30], axis=1).max() < 5.0


def test_a_stream_goes_on_where_a_cycle_ends(source):
    rows = log(8).select(source.inputs)[None]
    whole, _ = source.run(rows, source.initial_state(1))
    _, state = source.run(rows[:, :55], source.initial_state(1))
    rest, _ = source.run(rows[:, 55:], state)
    np.testing.assert_array_equal(rest, whole[:, 55:])


def test_each_log_is_a_cycle_by_default():
    logs = [log(seed).rows(0, TICKS + seed) for seed in range(3)]
    source = CyclesSpec().fit(material(*logs))
    assert len(source.template) == TICKS
    # What is longer than its cycle is not compared with the begin of another one.
    kept = Cycles.from_parts(source.parts())
    rows = log(5).rows(0, TICKS + 3).select(source.inputs)[None]
    begin, state = kept.run(rows[:, :30], kept.initial_state(1))
    end, _ = kept.run(rows[:, 30:], state)
    assert np.isfinite(begin).all()
    assert np.isfinite(end[:, : TICKS - 30]).all()
    assert np.isnan(end[:, TICKS - 30 :]).all()


@pytest.mark.parametrize("period_s", [0.01, 4.05])
def test_a_cycle_that_is_no_whole_number_of_ticks_is_refused(period_s):
    with pytest.raises(DataError, match=r"ticks of 10 Hz; a whole number"):
        CyclesSpec(period_s=period_s).fit(material(log(0), log(1)))


def test_too_few_cycles_and_too_long_ones_are_refused():
    with pytest.raises(DataError, match=r"0 cycles of 60 s .* 3 at least must hold"):
        CyclesSpec(period_s=60.0).fit(material(log(0)))
    with pytest.raises(DataError, match=r"1 to 1000000 must hold"):
        CyclesSpec(period_s=1e6).fit(material(log(0)))


def test_parts_of_a_file_that_cannot_be_are_refused(source):
    parts = source.parts()
    for name, values, why in (
        ("width", np.zeros((TICKS, 2)), "got 0.0 at .* above 0"),
        ("width", np.ones((TICKS, 3)), "shape"),
        ("template", np.full((TICKS, 2), np.nan), "got nan at .* finite"),
        ("template", np.zeros((0, 2)), "shape|ticks"),
    ):
        with pytest.raises(ValueError, match=why):
            Cycles.from_parts(SourceParts(parts.plain, parts.arrays | {name: values}))
    with pytest.raises(ValueError, match="repeats"):
        Cycles.from_parts(SourceParts({**parts.plain, "repeats": 1}, parts.arrays))
    none = {"template": np.zeros((0, 2)), "width": np.zeros((0, 2))}
    with pytest.raises(ValueError, match="0 ticks"):
        Cycles.from_parts(SourceParts(parts.plain, parts.arrays | none))
