"""Twins of tanks and masses: numbers that a fit finds again, elements that must connect."""

import numpy as np
import pytest

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError
from edp.networks.twin import fit_scales
from edp.networks.twin.elements import ElementsBox
from edp.networks.twin.lumped.parts import LagElement, MassElement, TankElement
from edp.signals import Channel, Kind
from edp.training.elements_fit import LumpedProblem, fit_elements

TANKS = ElementsBox(
    tanks=(TankElement(name="upper", source="pump"), TankElement(name="lower", source="upper", level="level")),
    prefix_ticks=10, starts=1, rounds=40,
)  # fmt: skip
CHANNELS = TwinChannels(
    (Channel("pump", Kind.RATIO),), (Channel("rate", Kind.VELOCITY),), (Channel("level", Kind.POSITION),), (), 0.25
)


@pytest.fixture(scope="module")
def tanks():
    """Two tanks of known numbers, and what they do: the scales are those of a plausible first run."""
    rng = np.random.default_rng(0)
    pump = np.repeat(rng.uniform(0, 3, 15), 10).astype(np.float32)[:, None]
    targets = np.stack([rng.normal(0, 0.05, 150), rng.uniform(0, 10, 150)], axis=1).astype(np.float32)
    scales = fit_scales(CHANNELS, [Series("scales", pump, targets)])
    twin = TANKS.start(CHANNELS, scales, [], 0)
    true = twin.with_parameters(np.array([0.02, 0.2, 0.04, 0.6, 0.5, 0.05, 0.5, 0.04, 0.55, 10.0, 0.1]))
    answers, _ = true.rollout(pump[None, :-1], true.initial_state(pump[:1], np.array([[0.0, 5.0]], np.float32)))
    rows = np.concatenate([[[0.0, 5.0]], answers[0]]).astype(np.float32)
    series = Series("run", pump, rows)
    return TANKS.start(CHANNELS, fit_scales(CHANNELS, [series]), [series], 0), true, series


def test_a_fit_finds_the_run_again(tanks):
    twin, _, series = tanks
    fit = fit_elements(twin, [series], [series], 0)
    state = fit.twin.reset(series.inputs[None, :10], series.targets[None, :10])
    answers, _ = fit.twin.rollout(series.inputs[None, 10:-1], state)
    error = np.sqrt(np.mean((answers[0, :, 1] - series.targets[11:, 1]) ** 2))
    assert error < 0.02 * series.targets[:, 1].std()
    assert [row.name for row in fit.datasheet] == [number.name for number in twin.table]
    assert all(row.low <= row.value <= row.high for row in fit.datasheet)


def test_slopes_are_those_of_differences(tanks):
    twin, _, series = tanks
    problem = LumpedProblem(twin, [series])
    rng = np.random.default_rng(1)
    point, way = (0.2 * rng.normal(size=problem.size) for _ in range(2))
    above, below = (problem.normal_equations(point + side * 1e-5 * way, False).cost for side in (1.0, -1.0))
    equations = problem.normal_equations(point, True)
    assert equations.gradient @ way == pytest.approx((above - below) / 2e-5, rel=1e-4)
    assert equations.cost == pytest.approx(problem.normal_equations(point, False).cost)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tanks": (TankElement(name="a", source="pomp", level="level"),)}, "tank 'a' is 'pomp'.*mean 'pump'"),
        ({"tanks": (TankElement(name="a", source="pump"),)}, "no element has the channel 'rate'"),
        ({"tanks": (TankElement(name="a", source="", level="level"),)}, "'source' of tank 'a' is not connected"),
        ({"tanks": (TankElement(name="a", source="pump", level="rate"),)}, "'level' of tank 'a' is 'rate'"),
        ({"masses": (MassElement(name="upper", command="pump", velocity="rate"),)}, "two are called 'upper'"),
        ({"masses": (MassElement(name="m", command="pump", velocity="rate"),)}, "'rate' is connected to tank"),
        ({"tanks": (TankElement(name="\x1b[2J", source="pump", level="level"),)}, "must be 1 to 64 printable"),
        ({"tanks": (TankElement(name="a" * 65, source="pump", level="level"),)}, "must be 1 to 64 printable"),
        ({"tanks": (TankElement(name=" ", source="pump", level="level"),)}, "must be 1 to 64 printable"),
        ({"lags": (LagElement(name="l", command="pump", pressure="p"),)}, "none .this twin has none."),
    ],
)  # fmt: skip
def test_elements_that_do_not_connect_are_refused(change, message):
    fields = {"tanks": TANKS.tanks, **change}
    with pytest.raises(ConfigError, match=message):
        ElementsBox(**fields).parts(CHANNELS)


def cut(series, samples):
    return Series(series.name, series.inputs[:samples], series.targets[:samples])


def test_recordings_of_any_length_are_fitted_to_their_ends(tanks):
    twin, _, series = tanks
    problem = LumpedProblem(twin, [series, cut(series, 60)])
    assert problem.truth.shape[:2] == (2, 149)
    assert np.isnan(problem.truth[1, 59:]).all()
    assert np.isfinite(problem.truth[1, :59]).all()
    # What the run says behind the end of its recording counts nowhere.
    every = (problem, *(LumpedProblem(twin, [one]) for one in (series, cut(series, 60))))
    both, first, second = (one.normal_equations(np.zeros(one.size), False).cost for one in every)
    assert both == pytest.approx(first + second)


def test_long_logs_are_fitted_in_as_many_runs_as_the_memory_holds(tanks, monkeypatch):
    twin, _, series = tanks
    monkeypatch.setattr("edp.training.elements_fit.MOST_TICKS", 20)
    assert LumpedProblem(twin, [series]).truth.shape[:2] == (8, 20)
    monkeypatch.setattr("edp.training.elements_fit.MAX_VALUES", 3 * 12 * 20 * 2)
    assert LumpedProblem(twin, [series]).truth.shape[:2] == (3, 20)


def test_a_length_that_no_stretch_has_is_refused(tanks):
    twin, _, series = tanks
    spec = ElementsBox(tanks=TANKS.tanks, length_s=600.0)
    longer = spec.start(CHANNELS, twin.scales, [series], 0)
    with pytest.raises(DataError, match=r"no training stretch has a free run of 600 s.*596 s"):
        LumpedProblem(longer, [cut(series, 150)])
