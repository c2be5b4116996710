"""Feature sets as TOML files, named by ``task.features``."""

from __future__ import annotations

import pytest

from edp.config.experiment import FeatureSettings, experiment_toml, load_experiment
from edp.data.feature_files import read_set_table, set_text
from edp.data.features import FG2, Derived, FeatureSet
from edp.errors import ConfigError
from edp.signals import Kind

ODD = FeatureSet(
    'a "b" \\', ("x y", 'q"', "umlaut ö", "tab\t"), (Derived("d", "x y", "derivative", Kind.FORCE),), ("h",)
)


def settings(features):
    return FeatureSettings(
        name=features.name, channels=features.channels, derived=features.derived, hidden=features.hidden
    )


@pytest.mark.parametrize("features", [FG2, ODD])
def test_a_set_is_written_and_read_back(tmp_path, features):
    path = tmp_path / "set.toml"
    why = {name: f"because\x00 {name}\n= [" for name in features.channels}
    path.write_text(set_text(features, ["head", "two\nlines"], why, ["tail \x1f"]), encoding="utf-8")
    found = load_experiment(overrides=[f"task.features={path}", "task.mode=absolute"]).task.features
    assert found == settings(features)


def test_paths_are_relative_to_the_settings_file(tmp_path, monkeypatch):
    (tmp_path / "sets").mkdir()
    (tmp_path / "sets" / "few.toml").write_text('channels = ["CylVels_1", "CylVels_2", "CylVels_3"]')
    (tmp_path / "run.toml").write_text('[task]\nfeatures = "sets/few.toml"')
    experiment = load_experiment(tmp_path / "run.toml")
    assert experiment.task.features.name == "few"
    assert experiment.task.resolve(100.0).features.features == ("CylVels_1", "CylVels_2", "CylVels_3")
    monkeypatch.chdir(tmp_path / "sets")
    assert load_experiment(overrides=["task.features=few.toml"]).task.features.name == "few"
    with pytest.raises(ConfigError, match=r"the feature set 'sets/few.toml' cannot be read.*relative to that file"):
        load_experiment(overrides=["task.features=sets/few.toml"])


def test_a_file_replaces_an_earlier_set_whole_and_a_run_folder_keeps_its_content(tmp_path):
    path = tmp_path / "few.toml"
    path.write_text('channels = ["CylVels_1", "CylVels_2", "CylVels_3"]')
    (tmp_path / "run.toml").write_text(
        '[task.features]\nchannels = ["CylVels_1"]\nderived = [{name = "d", source = "CylVels_1"}]\nhidden = ["BmUp"]'
    )
    experiment = load_experiment(tmp_path / "run.toml", overrides=[f"task.features={path}"])
    assert (experiment.task.features.derived, experiment.task.features.hidden) == ((), ())
    kept = tmp_path / "config.toml"
    kept.write_text(experiment_toml(experiment))
    path.unlink()
    assert load_experiment(kept, preset=None).task.features == experiment.task.features


def test_a_wrong_file_is_named(tmp_path):
    path = tmp_path / "set.toml"
    path.write_text('chanels = ["a"]\nhidden = 3')
    with pytest.raises(ConfigError, match=r"set.toml'.*\n.*unknown key 'chanels'.*channels.*\n.*hidden = 3"):
        load_experiment(overrides=[f"task.features={path}"])
    path.write_text("channels = [")
    with pytest.raises(ConfigError, match=r"set.toml' is not valid TOML"):
        read_set_table(path)
