"""Matching on synthetic rows: the right fault, its size, 'none of these', and the dictionary on disk."""

import json
from dataclasses import replace

import numpy as np
import pytest

from edp.errors import DataError, StorageError
from edp.monitor.diagnosis.causes import NONE_OF_THESE, FaultClass
from edp.monitor.diagnosis.evidence import ONSET, Scatter, mean_features, parts_of
from edp.monitor.diagnosis.learning import SimulatedFault, fit_dictionary
from edp.monitor.diagnosis.matching import causes_of, match
from edp.monitor.diagnosis.signatures import load_dictionary, save_dictionary

SUMMARIES = tuple(f"virtual:{n}.mean" for n in range(6))
CLASSES = (
    FaultClass(
        "bias", "boom", "sensor of boom", "sensor", "bar", (1.0, 3.0, 10.0), 0.0, False, "reads {size} too {high}"
    ),
    FaultClass(
        "bias", "arm", "sensor of arm", "sensor", "bar", (1.0, 3.0, 10.0), 0.0, False, "reads {size} too {high}"
    ),
    FaultClass("leak", "boom", "boom cylinder", "machine", "L/min", (1.0, 3.0), 0.0, True, "leaks {size}"),
    FaultClass("noise", "arm", "sensor of arm", "sensor", "x", (2.0, 4.0), 1.0, False, "noisy by {size}"),
    FaultClass("stuck", "arm", "arm valve", "machine", "", (), 0.0, True, "sticks"),
)
DIRECTIONS = np.eye(6)[:5]


def effect(owner, size, blocks, chance):
    """Conditioned rows of a fault: each moves a summary of its own, noise moves sizes only."""
    rows = chance.normal(size=(blocks, 6)) + 0.2 * chance.normal(size=6)
    fault = CLASSES[owner]
    if fault.kind == "noise":
        return rows * np.where(np.arange(6) == 3, size, 1.0)
    amount = {"bias": 0.4 * size, "leak": 0.8 * size, "stuck": 2.0}[fault.kind]
    return rows + amount * DIRECTIONS[owner]


def sessions():
    chance = np.random.default_rng(3)
    faults = []
    for draw in range(3):
        for owner, fault in enumerate(CLASSES):
            for size in fault.sizes or (0.0,):
                seed = int(chance.integers(1_000_000))
                rows = effect(owner, size, 80, np.random.default_rng(seed))
                twin = np.random.default_rng(seed)
                sound = twin.normal(size=(80, 6)) + 0.2 * twin.normal(size=6)
                pairs = zip(parts_of(rows), parts_of(sound), strict=True)
                change = np.stack([mean_features(one) - mean_features(other) for one, other in pairs])
                faults.append(SimulatedFault(draw, owner, size, change, {"Pump": np.array([float(owner)])}))
    return faults


def healthy(count=20):
    chance = np.random.default_rng(9)
    return [chance.normal(size=(200, 6)) + 0.2 * chance.normal(size=6) for _ in range(count)]


@pytest.fixture(scope="module")
def dictionary():
    return fit_dictionary(SUMMARIES, CLASSES, sessions(), healthy(), {"machine": "rig"})


@pytest.mark.parametrize(("owner", "size"), [(0, 5.0), (1, 3.0), (2, 2.0), (3, 4.0), (4, 0.0)])
def test_each_fault_is_named_with_its_part_and_about_its_size(dictionary, owner, size):
    right = 0
    for seed in range(8):
        rows = effect(owner, size, 40, np.random.default_rng([seed, owner]))
        causes = causes_of(dictionary, match(dictionary, rows))
        right += (causes[0].kind, causes[0].site) == (CLASSES[owner].kind, CLASSES[owner].site)
        assert sum(cause.probability for cause in causes) == pytest.approx(1.0, abs=1e-6)
        if CLASSES[owner].sizes and causes[0].kind == CLASSES[owner].kind:
            assert 0.5 * size <= causes[0].size <= 2.0 * size
    assert right >= 7


@pytest.mark.parametrize("clip", [6.0, np.inf])
@pytest.mark.parametrize(("owner", "times"), [(0, 2.0), (0, 4.0), (1, 6.0), (2, 5.0)])
def test_a_fault_far_beyond_its_ladder_keeps_its_name(dictionary, owner, times, clip):
    size = times * CLASSES[owner].sizes[-1]
    for seed in range(4):
        rows = np.clip(effect(owner, size, 40, np.random.default_rng([seed, owner])), -clip, clip)
        cause = causes_of(dictionary, match(dictionary, rows))[0]
        assert (cause.kind, cause.site) == (CLASSES[owner].kind, CLASSES[owner].site)
        assert cause.size >= 1.2 * CLASSES[owner].sizes[-1]


def test_causes_of_one_part_count_together(dictionary):
    found = match(dictionary, effect(0, 3.0, 40, np.random.default_rng(0)))
    shares = np.array([0.3, 0.25, 0.05, 0.3, 0.1])
    causes = causes_of(dictionary, replace(found, probabilities=shares, none=0.0))
    assert causes[0].component == "sensor of arm"
    assert {cause.component for cause in causes[:3]} == {"sensor of arm", "sensor of boom", "arm valve"}


def test_what_no_fault_explains_is_none_of_these(dictionary):
    rows = np.random.default_rng(5).normal(size=(40, 6))
    strange = rows + np.array([0.0, 0.0, -5.0, 0.0, 0.0, 6.0])
    causes = causes_of(dictionary, match(dictionary, strange))
    assert causes[0].kind == NONE_OF_THESE
    assert causes[0].probability > 0.5
    assert match(dictionary, rows + 1.2 * DIRECTIONS[0]).none < 0.5


def test_a_step_at_the_onset_is_known_by_its_onset():
    step = FaultClass("stroke", "boom", "sensor of stroke", "sensor", "", (), 0.0, False, "jumps")
    chance = np.random.default_rng(4)
    faults = sessions()
    for draw in range(3):
        change = 0.05 * chance.normal(size=(2, 12))
        change[0, 5] += 3.0
        faults.append(SimulatedFault(draw, len(CLASSES), 0.0, change, {"Pump": np.zeros(1)}))
    dictionary = fit_dictionary(SUMMARIES, (*CLASSES, step), faults, healthy(), {})
    rows = chance.normal(size=(60, 6))
    rows[:ONSET, 5] += 3.0
    assert causes_of(dictionary, match(dictionary, rows))[0].kind == "stroke"
    # Without an onset there is nothing of it.
    later = match(dictionary, rows[ONSET:] + DIRECTIONS[0], fresh=False)
    assert causes_of(dictionary, later)[0].kind == "bias"


def test_missing_summaries_count_as_healthy(dictionary):
    rows = effect(0, 6.0, 40, np.random.default_rng(1))
    rows[:, 4:] = np.nan
    causes = causes_of(dictionary, match(dictionary, rows))
    assert (causes[0].kind, causes[0].site) == ("bias", "boom")


def test_longer_evidence_is_surer(dictionary):
    found = [
        np.mean([
            match(dictionary, effect(0, 1.5, blocks, np.random.default_rng(seed))).probabilities[0]
            for seed in range(12)
        ])
        for blocks in (3, 60)
    ]  # fmt: skip
    assert found[1] > found[0]


def test_scatter_tells_what_passes_from_what_lasts():
    chance = np.random.default_rng(2)
    levels = [[chance.normal(size=(400, 3)) + level * chance.normal(size=3) for _ in range(60)] for level in (0.0, 1.0)]
    steady, drifting = (Scatter.fit(rows) for rows in levels)
    shares = [np.median(s.lasting / (s.lasting + s.passing / 8)) for s in (steady, drifting)]
    assert shares[0] < 0.3 < shares[1]
    assert (drifting.variance(100) < drifting.variance(2)).all()
    with pytest.raises(DataError, match="too few for a diagnosis"):
        Scatter.fit([np.zeros((10, 3))])


def test_a_summary_that_stands_still_says_nothing():
    still = [np.concatenate([rows, np.full((len(rows), 1), 0.5)], axis=1) for rows in healthy()]
    scatter = Scatter.fit(still)
    assert (scatter.variance(10) > 0.0).all()
    moved = np.zeros(14)
    moved[6] = 100.0
    assert np.abs(scatter.directions(scatter.mean + moved)).max() == 0.0


def test_a_fault_without_a_session_is_refused():
    with pytest.raises(DataError, match="has no session"):
        fit_dictionary(SUMMARIES, CLASSES, [s for s in sessions() if s.owner], healthy(), {})


def test_the_same_sessions_give_the_same_dictionary(dictionary):
    again = fit_dictionary(SUMMARIES, CLASSES, sessions(), healthy(), {"machine": "rig"})
    assert np.array_equal(again.signatures, dictionary.signatures)
    assert (again.changing, again.temperature, again.strange) == (
        dictionary.changing, dictionary.temperature, dictionary.strange,
    )  # fmt: skip


def test_a_dictionary_comes_back_from_disk(dictionary, tmp_path):
    assert load_dictionary(tmp_path, SUMMARIES) is None
    save_dictionary(dictionary, tmp_path)
    loaded = load_dictionary(tmp_path, SUMMARIES)
    rows = effect(0, 5.0, 40, np.random.default_rng(7))
    one, other = (causes_of(kept, match(kept, rows)) for kept in (dictionary, loaded))
    assert [cause.kind for cause in one] == [cause.kind for cause in other]
    assert one[0].probability == pytest.approx(other[0].probability, abs=1e-4)
    assert loaded.classes == dictionary.classes
    assert loaded.confusions == dictionary.confusions


def test_another_monitor_and_damage_are_refused(dictionary, tmp_path):
    save_dictionary(dictionary, tmp_path)
    with pytest.raises(StorageError, match="another monitor"):
        load_dictionary(tmp_path, SUMMARIES[:-1])
    header = json.loads((tmp_path / "dictionary.json").read_text())
    (tmp_path / "dictionary.json").write_text(json.dumps(header | {"temperature": -1.0}))
    with pytest.raises(StorageError, match="does not match its hash"):
        load_dictionary(tmp_path, SUMMARIES)
    save_dictionary(dictionary, tmp_path)
    data = (tmp_path / "dictionary.safetensors").read_bytes()
    (tmp_path / "dictionary.safetensors").write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(StorageError, match="does not match its hash"):
        load_dictionary(tmp_path, SUMMARIES)
