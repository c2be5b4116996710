"""Subspace identification finds a known system again; its order is chosen on recordings that are kept back."""

import numpy as np
import pytest
from scipy.signal import lfilter

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ConfigError, DataError
from edp.ir.reference import Reference
from edp.networks.twin import fit_scales
from edp.networks.twin.n4sid import N4sid, _divide, _gain, _stable
from edp.signals import Channel, Kind

RATE_HZ = 100.0
CHANNELS = TwinChannels(
    (Channel("lever_1", Kind.RATIO), Channel("lever_2", Kind.RATIO)),
    (Channel("speed_1", Kind.VELOCITY), Channel("speed_2", Kind.VELOCITY)),
    (),
    (Channel("pressure", Kind.PRESSURE),),
    RATE_HZ,
)
POLES = np.array([0.96, 0.9 * np.exp(0.5j), 0.9 * np.exp(-0.5j), 0.6])
UNITS = np.array([0.2, 0.3, 5e6])
REST = np.array([0.1, 0.0, 1e8])


def known_system(seed=0):
    """A random system with `POLES` as a sum of first and second order parts: A, B, C with blocks on the diagonal."""
    rng = np.random.default_rng(seed)
    a = np.zeros((4, 4))
    a[0, 0], a[3, 3] = POLES[0].real, POLES[3].real
    a[1:3, 1:3] = 0.9 * np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    return a, rng.normal(size=(4, 2)), UNITS[:, None] * rng.normal(size=(3, 4))


def recordings(count=4, ticks=3000, noise=0.1, seed=1):
    """Simulated by transfer functions of first order, without a state space: an independent way to the same outputs."""
    a, b, c = known_system()
    poles, vectors = np.linalg.eig(a)
    left, right = np.linalg.solve(vectors, b.astype(complex)), c @ vectors
    rng = np.random.default_rng(seed)
    series = []
    for i in range(count):
        u = np.repeat(rng.normal(size=(ticks // 4, 2)), 4, axis=0)
        modes = [lfilter([0.0, 1.0], [1.0, -pole], u @ row) for pole, row in zip(poles, left, strict=True)]
        y = np.real(np.stack(modes, axis=1) @ right.T) + noise * UNITS * rng.normal(size=(ticks, 3)) + REST
        series.append(Series(f"run {i}", u.astype(np.float32), y.astype(np.float32)))
    return series


def markov(twin, count=25):
    """Answers to impulses of the commands, in SI units ``(tick, answer, command)``."""
    scales = twin.scales
    b, c = twin.b[:, :-1] / scales.command_width, twin.c * scales.answer_width[:, None]
    return np.stack([c @ np.linalg.matrix_power(twin.a, k) @ b for k in range(count)])


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 1e-3), (0.1, 0.03)])
def test_poles_and_impulse_responses_of_a_known_system_are_found(noise, tolerance):
    series = recordings(noise=noise)
    twin = N4sid(orders=(4,)).start(CHANNELS, fit_scales(CHANNELS, series), series, 0)
    poles = np.linalg.eigvals(twin.a)
    assert np.abs(np.sort_complex(poles) - np.sort_complex(POLES)).max() < tolerance
    a, b, c = known_system()
    truth = np.stack([c @ np.linalg.matrix_power(a, k) @ b for k in range(25)]) / UNITS[:, None]
    assert np.abs(markov(twin) / UNITS[:, None] - truth).max() < tolerance * np.abs(truth).max()


def test_the_filter_predicts_better_than_the_free_run_where_noise_moves_the_system():
    """Kalman gain against the steady covariance of a scalar system, which is known in closed form."""
    rng = np.random.default_rng(0)
    a, q, r = 0.9, 0.04, 0.25
    process, output = np.sqrt(q) * rng.normal(size=(100_000, 1)), np.sqrt(r) * rng.normal(size=(100_000, 1))
    # p = a^2 p r / (p + r) + q
    p = np.roots([1.0, r * (1 - a * a) - q, -q * r]).max()
    gain = _gain(np.array([[a]]), np.array([[1.0]]), process, output)
    assert gain[0, 0] == pytest.approx(a * p / (p + r), rel=0.02)


@pytest.mark.long
def test_the_order_is_that_of_the_system():
    series = recordings(count=6, noise=0.05)
    twin = N4sid(orders=(1, 2, 4)).start(CHANNELS, fit_scales(CHANNELS, series), series, 0)
    assert twin.order == 4
    assert twin.numbers["a"].shape == (4, 4)


def test_unstable_and_slow_poles_become_stable():
    turned = np.array([[0.5, 2.0, 0.0], [0.0, 1.25, 0.0], [0.0, 0.0, 0.99999]])
    poles = np.sort(np.linalg.eigvals(_stable(turned)).real)
    assert poles == pytest.approx([0.5, 0.8, 0.999])
    assert _stable(turned[:1, :1]) is not None
    assert np.array_equal(_stable(0.5 * np.eye(2)), 0.5 * np.eye(2))


def test_every_fifth_recording_or_the_end_of_a_single_one_chooses_the_order():
    series = recordings(count=6, ticks=400)
    fitted, judged = _divide(series, 100)
    assert [part.name for part in judged] == ["run 4"]
    assert "run 4" not in [part.name for part in fitted]
    fitted, judged = _divide(series[:1], 100)
    assert (fitted[0].samples, judged[0].samples) == (300, 100)


def test_layers_answer_as_the_twin():
    series = recordings(ticks=600)
    twin = N4sid(orders=(4,), prefix_ticks=10).start(CHANNELS, fit_scales(CHANNELS, series), series, 0)
    commands, measured = series[0].inputs[:60], series[0].targets[:60].copy()
    free = np.arange(60) >= 10
    rows = np.concatenate([commands, measured, np.repeat(~free[:, None], 3, axis=1)], axis=1)
    reference = Reference(twin.graph())
    layers = np.stack([reference.results(row)["prediction"] for row in rows])
    # A graph rests at the means of the training data.
    rest = {"answer": twin.scales.answer_offset[None], "states": np.zeros((1, 4), np.float32)}
    measured[free] = np.nan
    answers, _ = twin.rollout(commands[None], rest, measured[None])
    assert np.abs((layers - answers[0]) / twin.scales.answer_width).max() < 1e-4


@pytest.mark.parametrize("options", [{"orders": ()}, {"orders": (0,)}, {"horizon": 1}])
def test_options_out_of_range_are_refused(options):
    with pytest.raises(ConfigError, match="n4sid"):
        N4sid(**options)


def test_recordings_too_short_for_the_horizon_are_refused():
    series = recordings(count=2, ticks=120)
    with pytest.raises(DataError, match=r"give longer recordings, or set a smaller twin\.horizon"):
        N4sid().start(CHANNELS, fit_scales(CHANNELS, series), series, 0)
