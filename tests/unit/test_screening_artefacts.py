"""Channels whose relations are made by the files: told on a law that is known."""

import numpy as np
import pytest

from edp.data.screening import FlagKind, ScreeningSpec
from edp.data.screening.artefacts import flag_broken
from edp.data.screening.table import build_table
from edp.recording import Recording
from edp.signals import Channel, Kind

NAMES = ("v", "turned", "steady", "weak", "sloped", "sometimes")


def drives(count=9, samples=700):
    """A velocity, and what shows it: with a sign of the file, as it is, hardly, with gains of the files, or in some."""
    rng = np.random.default_rng(4)
    signs = rng.permutation(np.resize([1.0, -1.0], count))
    made = []
    for i in range(count):
        v = np.cumsum(rng.normal(size=samples)) * (0.05 if i == 3 else 1.0)
        v -= v.mean()
        noise = rng.normal(size=(4, samples))
        columns = [v, signs[i] * v + noise[0], v + noise[1], signs[i] * v + 300 * noise[2],
                   signs[i] * rng.uniform(0.2, 5.0) * v + noise[3],
                   (i > 3) * v + rng.normal(size=samples)]  # fmt: skip
        channels = tuple(Channel(n, Kind.VELOCITY if n == "v" else Kind.GENERIC) for n in NAMES)
        made.append(Recording(f"drive_{i}", channels, np.stack(columns, axis=1).astype(np.float32), 100.0))
    return made


@pytest.fixture(scope="module")
def table():
    return build_table(drives(), ScreeningSpec(max_lag=20, horizon=5))


def test_one_gain_with_two_signs_is_an_artefact(table):
    turned, sometimes = flag_broken(table, list(range(6)), [1, 2, 3, 4, 5], [0])
    assert (turned.channel, turned.kind, turned.source) == ("turned", FlagKind.ARTEFACT, "v")
    assert "other sign in 4 of them" in turned.evidence
    assert (sometimes.channel, sometimes.kind, sometimes.source) == ("sometimes", FlagKind.ARTEFACT, "v")
    assert "not at all in 3 others" in sometimes.evidence


def test_only_what_is_judged_is_flagged(table):
    assert flag_broken(table, list(range(6)), [1, 3], [0]) != []
    assert flag_broken(table, list(range(6)), [3, 4], [0]) == []
