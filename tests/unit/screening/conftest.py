"""A small machine with known causes, and channels that a screening must see through."""

import numpy as np
import pytest

from edp.recording import Recording
from edp.signals import Channel, Kind

RATE_HZ = 100.0


def lfilter(*args: object) -> np.ndarray:
    # Late: workers of the quick check read this file and need no scipy.signal, which takes a second.
    from scipy import signal

    return signal.lfilter(*args)


def shifted(values: np.ndarray, lead: int) -> np.ndarray:
    return values[np.clip(np.arange(len(values)) + lead, 0, len(values) - 1)]


def steps(rng: np.random.Generator, count: int) -> np.ndarray:
    """Random levels held for a while, through a quick filter."""
    levels = rng.normal(size=count)[np.cumsum(rng.random(count) < 0.02)]
    return lfilter([0.3], [1.0, -0.7], levels)


def session(number: int, count: int = 3000) -> dict[str, np.ndarray]:
    """Two commands, two velocities that answer 12 and 8 samples later, a pressure, and false channels."""
    rng = np.random.default_rng(number)
    lever_a, lever_b = steps(rng, count), steps(rng, count)
    v_a = lfilter([0.1], [1.0, -0.9], shifted(lever_a, -5)) + 0.002 * rng.normal(size=count)
    v_b = lfilter([0.2], [1.0, -0.8], shifted(np.tanh(lever_b), -4)) + 0.002 * rng.normal(size=count)
    pressure = lever_a - 0.8 * v_a + 0.3 * np.abs(v_b) + 0.02 * rng.normal(size=count)
    return {
        "v_a": v_a,
        "v_b": v_b,
        "lever_a": lever_a + 0.01 * rng.normal(size=count),
        "lever_b": lever_b + 0.01 * rng.normal(size=count),
        "pressure": pressure,
        "aux_noise": rng.normal(size=count),
        "aux_slow": lfilter([1.0], [1.0, -0.998], rng.normal(size=count)),
        "aux_late": 3.0 * shifted(lever_b, -21) + 0.05 * rng.normal(size=count),
        "aux_ahead": shifted(v_b, 15) + 0.01 * rng.normal(size=count),
        "aux_smooth": np.convolve(v_a, np.ones(11) / 11, "same"),
        "aux_turned": v_a * (1 if number % 2 else -1) + 0.05 * rng.normal(size=count),
        "aux_session": np.full(count, float(number)),
        "aux_clock": np.arange(count) * 0.01,
        "aux_dead": np.full(count, 7.0),
    }


def recording(number: int, columns: dict[str, np.ndarray], rate_hz: float = RATE_HZ) -> Recording:
    channels = tuple(Channel(name, Kind.VELOCITY if name.startswith("v_") else Kind.GENERIC, "") for name in columns)
    values = np.stack(list(columns.values()), axis=1).astype(np.float32)
    return Recording(f"s{number}", channels, values, rate_hz, "made")


@pytest.fixture(scope="session")
def sessions() -> list[Recording]:
    return [recording(i, session(i)) for i in range(10)]
