"""Coverage of data sets: each figure on signals whose answer is known, and on recordings that lack channels."""

import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.data import events, spectrum
from edp.data.coverage import CELLS, INTEGRATED, MEASURED, cover, mutual_information
from edp.data.coverage_targets import wanted
from edp.data.roles import roles_of
from edp.data.splits import ByRecording, ByTime, Split, Stretch
from edp.errors import DataError
from edp.recording import Recording
from edp.signals import VOCABULARY, Channel, Kind

PILOTS = ("BmUp", "BmDwn", "AmIn", "AmOut", "BktIn", "BktOut")


def record(columns, name="r", rate=100.0, meta=None):
    """A recording from columns; names outside the vocabulary come as ``name:kind``."""
    channels = [
        VOCABULARY[key] if key in VOCABULARY else Channel(key.split(":")[0], Kind(key.split(":")[1])) for key in columns
    ]
    values = np.stack(list(columns.values()), axis=1).astype(np.float32)
    return Recording(name, tuple(channels), values, rate, "test", meta or {})


def machine_like(samples=3000, seed=0, name="r", meta=None, leave=()):
    rng = np.random.default_rng(seed)
    columns = {}
    for i in range(3):
        command = np.repeat(rng.normal(0, 12e5, samples // 50), 50)
        columns[PILOTS[2 * i]], columns[PILOTS[2 * i + 1]] = np.maximum(command, 0), np.maximum(-command, 0)
        columns[f"CylVels_{i + 1}"] = 1e-7 * command + rng.normal(0, 1e-3, samples)
        columns[f"CylPressures_{i + 1}"] = 1e7 + command
        columns[f"CylPressures_{i + 5}"] = 1e7 - command
        columns[f"CylStroke_{i + 1}"] = rng.uniform(0.0, 1.2, samples)
    order = [key for key in VOCABULARY if key in columns and key not in leave]
    return record({key: columns[key] for key in order}, name, meta=meta)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 999), lags=st.integers(1, 6), width=st.integers(1, 3))
def test_gram_is_that_of_the_hankel_matrix(seed, lags, width):
    rng = np.random.default_rng(seed)
    stretches = [rng.normal(size=(n, width)) for n in (30, 5, 17)]
    gram, columns = spectrum.hankel_gram(stretches, lags)
    hankel = np.concatenate(
        [np.stack([u[t : t + lags].ravel() for t in range(len(u) - lags + 1)]) for u in stretches if len(u) >= lags]
    )
    assert columns == len(hankel)
    np.testing.assert_allclose(gram, hankel.T @ hankel, atol=1e-9)


def test_white_noise_excites_every_order_and_a_sine_two():
    rng = np.random.default_rng(0)
    white = spectrum.smallest_singular_values([rng.normal(size=(40_000, 2))])
    assert min(white.values()) > 0.85
    sine = spectrum.smallest_singular_values([np.sin(0.3 * np.arange(5000))[:, None]])
    assert sine[2] > 0.1
    assert sine[3] < 1e-3
    assert spectrum.smallest_singular_values([rng.normal(size=(60, 2))]) == {}


def test_a_filtered_input_is_flat_up_to_its_bandwidth():
    from scipy import signal

    rng = np.random.default_rng(1)
    white = rng.normal(size=200_000)
    frequency, power = spectrum.density([white[:, None]], 100.0)
    flat, drop = spectrum.flat_to(frequency, power[:, 0], 4.0)
    assert (flat, abs(drop) < 2) == (50.0, True)
    slow = signal.lfilter(*signal.butter(2, 2.0, fs=100.0), white)
    frequency, power = spectrum.density([slow[:, None]], 100.0)
    flat, drop = spectrum.flat_to(frequency, power[:, 0], 4.0)
    assert flat == pytest.approx(2.0 * 9**0.25, rel=0.1)  # |H|^2 = 1 / (1 + (f / 2)^4) = 0.1
    assert drop == pytest.approx(10 * np.log10(1 + 2**4), abs=1.5)


def test_reversals_and_rises_are_counted():
    command = np.array([0, 1, 0.1, -0.1, 1, 0, -1, -1, 0, -1, 1.0])
    assert events.reversals(command, 0.5) == 2
    assert events.rises(np.abs(command) > 0.5) == 4
    assert events.rises(np.array([True, False, True])) == 2
    assert events.rises(np.zeros(3, dtype=bool)) == 0


def test_information_of_copies_noise_and_chance():
    rng = np.random.default_rng(2)
    x, y = rng.normal(size=(2, 50_000))
    assert mutual_information(x, x) == pytest.approx(np.log(32), abs=0.02)
    assert mutual_information(x, y) < 0.002
    both = 0.8 * x + 0.6 * y
    assert mutual_information(x, both) == pytest.approx(-0.5 * np.log(1 - 0.64), rel=0.12)


def test_a_machine_of_table_a1_is_covered_whole():
    runs = [machine_like(seed=i, name=f"r{i}", meta={"full_strokes_m": [1.2, 1.2, 1.2]}) for i in range(4)]
    found = cover(runs, split=ByRecording().split(runs, 10))
    assert found.inputs == PILOTS
    assert (found.recordings, found.hours) == (4, pytest.approx(4 * 30 / 3600))
    assert found.occupancy.source == MEASURED
    assert found.occupancy.full_stroke
    assert found.occupancy.samples.shape == (CELLS,) * 3
    assert found.occupancy.samples.sum() == 12_000
    assert found.occupancy.share > 0.99
    groups = [joint.group for joint in found.joints]
    assert [groups.count(g) for g in ("command", "head pressure", "rod pressure", "velocities")] == [3, 3, 3, 3]
    assert found.joints[0].correlation > 0.95
    assert found.joints[0].counts.sum() == pytest.approx(12_000, rel=0.01)
    assert all(axis.crossings >= axis.reversals > 50 for axis in found.activity)
    assert sum(value for key, value in found.together.items() if "ax" in key) == pytest.approx(1.0)
    contact, *others = found.events
    assert contact.count > 0
    assert all(event.note == "not recorded" for event in others)
    assert found.distance.test[0] == pytest.approx(found.distance.train[0], rel=0.3)
    assert 0.0 <= found.distance.beyond < 0.3
    json.dumps(found.to_json(), allow_nan=False)


def test_events_are_counted_where_they_are_recorded():
    columns = {"CylVels_1": np.zeros(10), "Event_Relief": np.array([0, 1, 1, 0, 0, 1, 0, 0, 0, 0.0])}
    relief = next(event for event in cover([record(columns)]).events if event.name == "relief")
    assert (relief.count, relief.share) == (2, pytest.approx(0.3))


def test_without_strokes_velocity_is_integrated_and_said_so():
    runs = [machine_like(leave=[f"CylStroke_{i}" for i in (1, 2, 3)])]
    found = cover(runs)
    assert found.occupancy.source == INTEGRATED
    assert not found.occupancy.full_stroke
    assert any("integrates velocities" in note for note in found.absent)
    assert found.events[0].count is None


@pytest.mark.parametrize(
    "columns",
    [
        {"v:velocity": np.sin(np.arange(400) / 20)},
        {"v:velocity": np.sin(np.arange(400) / 20), "u:voltage": np.cos(np.arange(400) / 20)},
        {"u:voltage": np.cos(np.arange(400) / 20)},
        {"u:voltage": np.zeros(400), "v:velocity": np.zeros(400)},
        {"v:velocity": np.ones(3)},
        {"BmUp": np.arange(400.0), "BmDwn": np.zeros(400)},
        {"q:angular_velocity": np.sin(np.arange(400) / 9), "phi:angle": np.arange(400.0), "i:current": np.ones(400)},
    ],
)
def test_any_recording_with_a_motion_or_a_command_is_covered(columns):
    found = cover([record(columns)])
    plain = found.to_json()
    json.dumps(plain, allow_nan=False)
    assert plain["absent"]
    assert found.distance is None


def test_roles_go_by_kind_by_order_or_by_what_is_asked():
    ones = np.ones(5)
    rig = record({"a:velocity": ones, "b:velocity": ones, "p:pressure": ones, "q:pressure": ones, "u:voltage": ones})
    roles = roles_of(rig)
    assert [(axis.velocity, axis.command, axis.pressures) for axis in roles.axes] == [
        ("a", ("u",), ("p",)),
        ("b", ("u",), ("q",)),
    ]
    pairs = record({"a:velocity": ones, "up:pilot_pressure": ones, "down:pilot_pressure": ones})
    assert roles_of(pairs).axes[0].command == ("up", "down")
    named = roles_of(rig, ["p", "q"])
    assert [axis.command for axis in named.axes] == [("p",), ("q",)]
    assert named.inputs == ("p", "q")
    plain = record({"r:generic": ones, "s:generic": ones, "y:generic": ones, "z:generic": ones})
    assert roles_of(plain).axes == ()
    assert [(axis.command, axis.velocity) for axis in roles_of(plain, ["r", "s"]).axes] == [
        (("r",), "y"),
        (("s",), "z"),
    ]
    assert cover([plain], ["r", "s"]).occupancy is None
    with pytest.raises(DataError, match="input 'w' is not a channel"):
        roles_of(rig, ["w"])


def test_what_cannot_be_covered_is_refused():
    with pytest.raises(DataError, match="no recordings"):
        cover([])
    with pytest.raises(DataError, match="neither a velocity nor a command"):
        cover([record({"T:temperature": np.ones(5)})])
    with pytest.raises(DataError, match="one rate"):
        cover(
            [machine_like(), machine_like(leave=()).rows(0, 100).__class__(**{**vars(machine_like()), "rate_hz": 50.0})]
        )


def test_tests_unlike_training_lie_far_away():
    near, far = machine_like(seed=0, name="a"), machine_like(seed=1, name="b")
    moved = far.values.copy()
    moved[:, :3] += 5.0
    far = Recording("b", far.channels, moved, 100.0)
    split = Split((Stretch(0, 0, 2000),), (Stretch(0, 2000, 2500),), (Stretch(1, 0, 3000),))
    distance = cover([near, far], split=split).distance
    assert distance.beyond == 1.0
    assert distance.test[0] > 3 * distance.train[0]
    own = cover([near], split=ByTime().split([near], 10)).distance
    assert own.test[0] < 1.0


def test_figures_are_judged_by_what_is_wanted_of_them():
    rng = np.random.default_rng(0)
    meta = {"full_strokes_m": [1.2, 1.2, 1.2]}
    slow = wanted(cover([machine_like(30_000, meta=meta)]))
    assert [(w.unit, w.met) for w in slow] == [("%", True)] + [("Hz", False)] * 3
    noise = {name: np.maximum(sign * rng.normal(size=20_000), 0) for name, sign in (("BmUp", 1), ("BmDwn", -1))}
    (flat,) = wanted(cover([record(noise)]))
    assert flat.met
    assert flat.to_json()["met"] is True
    assert not wanted(cover([record({"CylVels_1": rng.normal(size=100)})]))[1:]
    with_split = cover([machine_like(3000)], split=ByTime().split([machine_like(3000)], 10))
    (far,) = (w for w in wanted(with_split) if not w.at_least)
    assert far.met == (with_split.distance.beyond <= 0.1)
