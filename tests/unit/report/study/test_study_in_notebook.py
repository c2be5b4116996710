"""A study as a notebook shows it."""

import copy
import json

import pytest

import edp
from edp.errors import ConfigError, StorageError

pytestmark = pytest.mark.long


@pytest.fixture
def folder(tmp_path, sound):
    (tmp_path / "study.json").write_text(json.dumps(sound), encoding="utf-8")
    return tmp_path


def test_a_study_is_sentences_a_table_and_figures(folder):
    study = edp.load_study(folder)
    assert study.state == "finished"
    assert "Phase" in study._repr_html_()
    assert repr(study).count(".") >= 2
    for name in ("variance", "pareto", "confirmation", "screening", "history"):
        figure = study.plot(name)
        assert figure.data
        assert all(trace.visible is not False for trace in figure.data)
    assert study.plot().data[0].name == study.plot("variance").data[0].name
    with pytest.raises(ConfigError, match="no figure 'paretto'; did you mean 'pareto'"):
        study.plot("paretto")


def test_a_study_that_has_decided_nothing_says_so(tmp_path, sound):
    study = copy.deepcopy(sound)
    study |= {"state": "running", "decisions": [], "history": [], "openings": []}
    (tmp_path / "study.json").write_text(json.dumps(study), encoding="utf-8")
    loaded = edp.load_study(tmp_path / "study.json")
    assert "0 of" in repr(loaded)
    with pytest.raises(ConfigError, match="nothing to draw yet"):
        loaded.plot()


def test_hostile_names_stay_text(folder, sound):
    study = copy.deepcopy(sound)
    study["data"]["path"] = "<script>alert(1)</script>"
    study["modules"] = {name: f"<img src=x>{name}" for name in study["modules"]}
    (folder / "study.json").write_text(json.dumps(study), encoding="utf-8")
    loaded = edp.load_study(folder)
    assert "<script" not in loaded._repr_html_()
    assert "<img" not in loaded._repr_html_()
    for name in ("variance", "confirmation", "screening", "history"):
        assert "<img" not in loaded.plot(name).to_json().replace("\\u003c", "<")


def test_what_is_no_study_is_one_error(tmp_path):
    with pytest.raises(StorageError, match="holds no study"):
        edp.load_study(tmp_path)
