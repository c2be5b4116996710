"""The task of the preset auto on recordings that lack some of the usual channels."""

from __future__ import annotations

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.recording import Recording
from edp.signals import TABLE_A1, VOCABULARY
from edp.workflows.auto import load_auto
from edp.workflows.auto.recordings import fit_to_channels


def fitted(*absent, more=(), changes=()):
    names = [name for name in TABLE_A1 if name not in absent] + list(more)
    settings, notes = fit_to_channels(load_auto(None, list(changes)), names, "logs")
    return settings.task, notes, names


def test_the_usual_channels_need_no_word():
    task, notes, _ = fitted()
    assert task.features == "FG2"
    assert notes == []


def test_an_acceleration_is_derived_from_its_velocity():
    task, notes, names = fitted("CylAcc_1")
    assert notes == ["Derived by EDP: CylAcc_1 from CylVels_1."]
    resolved = task.resolve(100.0)
    assert set(resolved.features.features) == {*TABLE_A1, *(f"d{name}" for name in TABLE_A1 if "Pressures" in name)}
    values = np.float32(np.random.default_rng(0).normal(size=(50, len(names))))
    recording = Recording("r", tuple(TABLE_A1[name] for name in names), values, 100.0)
    assert resolved.series(recording).inputs.shape == (50, len(names))


def test_velocities_that_are_to_be_predicted_are_derived_from_strokes():
    strokes = tuple(f"CylStroke_{axis}" for axis in (1, 2, 3))
    task, notes, names = fitted("CylVels_1", "CylVels_2", "CylVels_3", more=strokes)
    assert "CylVels_1 from CylStroke_1" in notes[0]
    values = np.float32(np.cumsum(np.random.default_rng(0).normal(size=(50, len(names))), axis=0))
    recording = Recording("r", tuple(VOCABULARY[name] for name in names), values, 100.0)
    series = task.resolve(100.0).series(recording)
    moved = np.diff(recording.column("CylStroke_2")) * 100.0
    np.testing.assert_allclose(series.targets[1:, 1], moved, rtol=1e-4, atol=1e-3)


def test_what_cannot_be_derived_is_said_and_every_channel_read():
    task, notes, names = fitted("CylAcc_1", "BmUpConf", more=("OilTemperature",))
    assert notes[1] == "Of the usual channels BmUpConf are not there: every channel of the logs is read."
    assert task.features.channels == tuple(names)
    other, nothing, _ = fitted("BmUpConf")
    assert (other.features, nothing) == ("all", [])


def test_a_target_that_is_nowhere_is_refused():
    with pytest.raises(ConfigError, match=r"task\.targets: CylVels_1, CylVels_2, CylVels_3 is no channel of 'logs'"):
        fitted("CylVels_1", "CylVels_2", "CylVels_3")
