"""A stranger's or a damaged twin is refused with one message, before its sizes are taken for memory."""

import json

import numpy as np
import pytest
from safetensors.numpy import load, save

from edp.errors import BundleError
from edp.networks.twin import TWINS
from edp.networks.twin.recurrent import Recurrent
from edp.settings.provenance import Provenance
from edp.testing.twins import sample_twin
from edp.training.bundle import HASH, content_digest, write_arrays
from edp.training.twin_bundle import HEADER, TwinBundle, load_twin, save_twin

SPEC = Recurrent(units=4, prefix_ticks=5)


@pytest.fixture
def folder(tmp_path):
    return save_twin(TwinBundle(SPEC, sample_twin(SPEC)[0], Provenance(seconds=1.0), {"twin": {}}), tmp_path / "twin")


def header_of(folder):
    return json.loads((folder / HEADER).read_text())


def changed(folder, change, hashed=True):
    """Change a header in place; with `hashed` the hash is made to fit, as somebody who means it would do."""
    header = header_of(folder)
    change(header)
    (folder / HEADER).write_text(json.dumps(header | ({HASH: content_digest(header)} if hashed else {})))


def refused(folder, match):
    with pytest.raises(BundleError, match=match) as caught:
        load_twin(folder)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize("name", list(TWINS))
def test_a_twin_comes_back_to_the_bit(tmp_path, name):
    spec = TWINS[name]()
    twin, commands, measured = sample_twin(spec)
    save_twin(TwinBundle(spec, twin, Provenance(seconds=2.0), {"twin": {"diverged": 0.0}}), tmp_path)
    loaded = load_twin(tmp_path)
    assert loaded.spec == spec
    assert loaded.twin.channels == twin.channels
    assert (loaded.provenance, loaded.scores) == (Provenance(seconds=2.0), {"twin": {"diverged": 0.0}})
    prefix = spec.prefix_ticks
    answers = [
        t.rollout(commands[:, prefix:], t.reset(commands[:, :prefix], measured[:, :prefix]))[0]
        for t in (twin, loaded.twin)
    ]
    assert np.array_equal(*answers)


def test_a_second_save_leaves_no_old_weights(folder):
    other = Recurrent(units=5, prefix_ticks=5)
    save_twin(TwinBundle(other, sample_twin(other)[0]), folder)
    assert len(list(folder.glob("weights-*"))) == 1
    assert load_twin(folder).spec == other


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h.update(schema=4), "has schema 4, this EDP"),
        (lambda h: h.update(schema=3), "ground"),
        (lambda h: h.update(schema=3, ground={"kind": "drag"}), "a ground acts on a grey box"),
        (lambda h: h.update(schema=True), "has schema True"),
        (lambda h: h.update(rate_hz=0.0), "rate_hz is 0.0"),
        (lambda h: h.update(rate_hz="50"), "rate_hz is 50"),
        (
            lambda h: h["twin"].update(units=5),
            r"'command_weight': got float32 of shape \(12, 2\), expected float32 of shape \(15, 2\)",
        ),
        (lambda h: h["twin"].update(units=4096), r"expected float32 of shape \(12288, 2\)"),
        (lambda h: h["twin"].update(units=10**9), "units = 1000000000; .* must hold"),
        (lambda h: h["twin"].update(kind="nothing"), "unknown twin 'nothing'"),
        (lambda h: h.update(twin={"kind": "static"}), "expected no array of this name"),
        (lambda h: h["channels"]["commands"].clear(), "a twin has no commands"),
        (lambda h: h["channels"]["strokes"].pop(), "one for each velocity"),
        (lambda h: h["channels"]["velocities"][0].update(unit="mm/s"), "is in mm/s, m/s must hold"),
        (lambda h: h["channels"]["velocities"][0].update(name=3), "'3' stands where a text must be"),
        (lambda h: h["channels"].pop("pressures"), "lacks 'pressures'"),
        (lambda h: h["weights"].update(file="../../etc/passwd"), "lacks its weights 'passwd'"),
        (lambda h: h.update(provenance=[]), "provenance"),
    ],
)
def test_a_header_that_means_harm_is_refused(folder, change, message):
    changed(folder, change)
    refused(folder, message)


def test_a_header_that_was_edited_is_refused(folder):
    changed(folder, lambda h: h["channels"]["strokes"].reverse(), hashed=False)
    refused(folder, "does not match its hash")


def rewritten(folder, change):
    """Change the arrays, with digests that fit."""
    entry = header_of(folder)["weights"]
    arrays = load((folder / entry["file"]).read_bytes())
    change(arrays)
    changed(folder, lambda h: h.update(weights=write_arrays(folder, "weights", save(arrays))))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a["h_weight"].fill(np.nan), "'h_weight': got nan at .*, expected .* finite"),
        (lambda a: a.pop("h_weight"), "'h_weight': got no array, expected float32"),
        (lambda a: a.update(more=np.zeros(3, np.float32)), "'more': got float32 .* expected no array of this name"),
        (lambda a: a.update(bias=a["bias"].astype(np.float64)), "'bias': got float64 .*, expected float32"),
        (lambda a: a["answer_width"].fill(0.0), "answer_width holds a number that is not positive"),
        (lambda a: a["low"].fill(1e30), "a bound of its answers is not below the other"),
    ],
)
def test_numbers_that_cannot_be_are_refused(folder, change, message):
    rewritten(folder, change)
    refused(folder, message)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda a: a["map_delay"].fill(2.5), "its delay is 2.5 ticks; an integer from 0"),
        (lambda a: a["map_delay"].fill(-1), "its delay is -1 ticks"),
        (lambda a: a["map_delay"].fill(3e38), "its delay is 3e\\+38 ticks"),
        (lambda a: a["map_corners"].fill(0.0), "its corners do not rise evenly"),
        (lambda a: a.update(map_corners=a["map_corners"][::-1].copy()), "its corners do not rise evenly"),
        (lambda a: a["map_corners"][-1].fill(3e38), "its corners do not rise evenly"),
        (lambda a: a.pop("map_rise"), "'map_rise': got no array"),
        (lambda a: a.update(map_weight=a["map_rise"]), "'map_weight': got .* expected no array of this name"),
        (lambda a: a.pop("pull"), "'pull': got no array"),
        (lambda a: a["pull"].fill(np.inf), "'pull': got inf at .*, expected .* finite"),
    ],
)
def test_a_static_map_that_cannot_be_is_refused(tmp_path, change, message):
    spec = Recurrent(units=4, members=2, valve_map=True, prefix_ticks=5)
    folder = save_twin(TwinBundle(spec, sample_twin(spec)[0], Provenance(seconds=1.0), {"twin": {}}), tmp_path / "twin")
    rewritten(folder, change)
    refused(folder, message)


@pytest.mark.parametrize("pull", [-1e30, 1e30])
def test_a_pull_beyond_its_share_leaves_answers_within_the_bounds(tmp_path, pull):
    spec = Recurrent(units=4, valve_map=True, prefix_ticks=5)
    twin, commands, measured = sample_twin(spec)
    folder = save_twin(TwinBundle(spec, twin), tmp_path / "twin")
    rewritten(folder, lambda a: a["pull"].fill(pull))
    loaded = load_twin(folder).twin
    state = loaded.reset(commands[:, :5], measured[:, :5])
    answers, _ = loaded.rollout(1e9 * commands[:, 5:], state)
    slack = 1e-5 * (loaded.scales.high - loaded.scales.low)
    assert ((answers >= loaded.scales.low - slack) & (answers <= loaded.scales.high + slack)).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h: h["twin"].update(members=3), "4 units and 3 members"),
        (lambda h: h["twin"].update(members=10**9), "members = 1000000000"),
        (lambda h: h["twin"].update(valve_map=True), r"got .*, expected no array of this name|got no array, expected"),
        (lambda h: h["twin"].update(valve_map="yes"), "valve_map"),
        (lambda h: h.update(twin={"kind": "auto"}), "unknown twin 'auto'"),
    ],
)
def test_options_of_a_choice_that_mean_harm_are_refused(folder, change, message):
    changed(folder, change)
    refused(folder, message)


def test_weights_that_were_cut_off_are_refused(folder):
    file = folder / header_of(folder)["weights"]["file"]
    file.write_bytes(file.read_bytes()[:-4])
    refused(folder, "do not match their digest")
    file.unlink()
    refused(folder, "lacks its weights")
