"""Settings: presets, files, overrides, round trips, and problems reported all at once."""

import dataclasses

import pytest

from edp.config.experiment import (
    PRESETS,
    SETTINGS,
    build,
    experiment_toml,
    load_experiment,
    merged,
    plain_tree,
)
from edp.config.twin import load_twin_experiment
from edp.data.features import FG2
from edp.data.task import TargetMode
from edp.errors import ConfigError, DataError
from edp.logs.repair import Repair
from edp.logs.source import DataSetSettings, load_data_set, load_signal_map
from edp.networks.heads import GluHead, MlpHead
from edp.networks.plain import model_from_dict, model_to_dict
from edp.networks.predictor import ModelSpec
from edp.signals import Kind


def saved(tmp_path, text, name="settings.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_load_and_survive_a_round_trip(preset, tmp_path):
    experiment = load_experiment(preset=preset)
    again = load_experiment(saved(tmp_path, experiment_toml(experiment)))  # as a run folder is read
    assert plain_tree(again) == plain_tree(experiment)


@pytest.mark.parametrize("preset", ["pressures", "positions"])
def test_presets_of_other_targets_are_the_quick_one_with_these_beside_its_features(preset):
    own, quick = load_experiment(preset=preset), load_experiment(preset="quick")
    assert plain_tree(dataclasses.replace(own, task=quick.task)) == plain_tree(quick)
    assert (own.task.horizons, own.task.mode) == (quick.task.horizons, quick.task.mode)
    features, before = own.task.features, FG2
    assert features.channels[: len(before.channels)] == before.channels
    assert features.derived[: len(before.derived)] == before.derived
    assert set(own.task.targets) <= set(features.channels)


def test_every_registered_part_survives_a_round_trip(tmp_path):
    places = {
        "backbone": ("model", "backbone"),
        "cell": ("model", "backbone", "cell"),
        "initial": ("model", "backbone", "initial"),
        "activation": ("model", "activation"),
        "head": ("model", "head"),
        "output": ("model", "output"),
        "loss": ("training", "loss"),
        "optimizer": ("training", "optimizer"),
        "schedule": ("training", "schedule"),
        "average": ("training", "average"),
        "split": ("split",),
        "physics": ("model", "physics"),
    }
    lists = {"terms", "augmentations"}
    assert set(SETTINGS.parts) == {*places, *lists, "blocks"}
    for name in lists:
        kinds = ", ".join(f'{{kind="{kind}"}}' for kind in SETTINGS.parts[name])
        experiment = load_experiment(overrides=[f"training.{name}=[{kinds}]"])
        again = load_experiment(saved(tmp_path, experiment_toml(experiment)))
        assert [SETTINGS.parts[name].name_of(part) for part in getattr(again.training, name)] == list(
            SETTINGS.parts[name]
        )
    for name, place in places.items():
        for kind in SETTINGS.parts[name]:
            experiment = load_experiment(overrides=[f"{'.'.join(place)}.kind={kind}", "model.blocks=[]"])
            again = load_experiment(saved(tmp_path, experiment_toml(experiment)))
            assert plain_tree(again) == plain_tree(experiment)
            part = plain_tree(experiment)
            for key in place:
                part = part[key]
            assert part["kind"] == kind


def test_a_head_without_a_kind_is_the_usual_one():
    old = load_experiment(overrides=["model.head={ hidden = 7, layers = 2 }"]).model.head
    assert old == MlpHead(hidden=7, layers=2)
    assert load_experiment(overrides=["model.head=glu"]).model.head == GluHead()
    with pytest.raises(ConfigError, match=r"model.head.kind: unknown head 'glue'.*did you mean 'glu'"):
        load_experiment(overrides=["model.head=glue"])
    plain = model_to_dict(ModelSpec(head=old))
    del plain["head"]["kind"]  # as bundles were written before heads had kinds
    assert model_from_dict(plain).head == old


def test_files_lie_over_the_preset_and_overrides_over_the_file(tmp_path):
    path = saved(tmp_path, "[training]\nepochs = 7\nupdates = 9\n")
    experiment = load_experiment(path, "quick", ["training.updates=11", "training.device=cpu"])
    assert (experiment.training.epochs, experiment.training.updates, experiment.training.device) == (7, 11, "cpu")
    assert experiment.training.chunks == load_experiment(preset="quick").training.chunks


def test_another_kind_replaces_the_table_whole():
    base = {"backbone": {"kind": "hybrid", "channels": [64]}, "kept": 1}
    assert merged(base, {"backbone": {"kind": "lstm"}}) == {"backbone": {"kind": "lstm"}, "kept": 1}
    assert merged(base, {"backbone": {"units": 3}})["backbone"] == {"kind": "hybrid", "channels": [64], "units": 3}


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 0, 2)])
def test_a_kind_and_its_options_may_be_given_in_any_order(tmp_path, order):
    changes = ["model.backbone.units=8", "model.backbone.kind=gru", "model.backbone.layers=2"]
    path = saved(tmp_path, '[model]\nbackbone = { kind = "lstm", dropout = 0.5 }\n')
    backbone = load_experiment(path, "quick", [changes[i] for i in order]).model.backbone
    assert (type(backbone).__name__, backbone.units, backbone.layers, backbone.dropout) == ("GruSpec", 8, 2, 0.0)


def test_options_of_a_file_that_names_no_kind_are_those_of_the_kind_on_the_command_line(tmp_path):
    path = saved(tmp_path, "[twin]\nunits = 48\n")
    for changes in (["twin.members=2", "twin.kind=recurrent"], ["twin.kind=recurrent", "twin.members=2"]):
        twin = load_twin_experiment(path, changes).twin
        assert (twin.units, twin.members) == (48, 2)
    with pytest.raises(ConfigError, match="units"):
        load_twin_experiment(path, ["twin.kind=static"])


def test_all_problems_are_reported_at_once(tmp_path):
    path = saved(
        tmp_path,
        """
        [task]
        mode = "deltas"
        [modle]
        window = 50
        [model]
        window = "long"
        backbone = { kind = "hybird" }
        blocks = [{ form = "diagonal" }, { kind = "cylinder_gate", from = "diagonal" }]
        [training]
        epochs = 0
        loss = { kind = "huber", delta = -1.0 }
        """,
    )
    with pytest.raises(ConfigError) as caught:
        load_experiment(path)
    text = str(caught.value)
    for part in (
        "settings.toml",
        "task.mode",
        "unknown key 'modle'; did you mean 'model'?",
        "model.window = 'long'",
        "unknown backbone 'hybird'; did you mean 'hybrid'?",
        "model.blocks[0]: say which block",
        "unknown key 'model.blocks[1].from'; did you mean 'form'?",
        "training.loss:",
    ):
        assert part in text


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("training.epochs", "write key.path=value"),
        ("=3", "write key.path=value"),
        ("training.epochs=0", "epochs = 0"),
        ("training.epochs=2.5", "training.epochs = 2.5"),
        ("training=fast", "training: expected a table, got 'fast'"),
        ("task.features=FG3", "did you mean 'FG"),
        ("task.targets=['a' 'b']", "--set"),
    ],
)
def test_overrides_that_cannot_be(override, words):
    with pytest.raises(ConfigError) as caught:
        load_experiment(overrides=[override]).task.resolve(100.0)
    assert words in str(caught.value)


def test_tasks_take_the_rate_of_the_data_and_its_channels():
    task = load_experiment(overrides=["task.features=all", "task.mode=absolute", 'task.targets=["b"]']).task
    resolved = task.resolve(50.0, ["a", "b"])
    assert resolved.rate_hz == 50.0
    assert resolved.features.channels == ("a", "b")
    assert resolved.mode is TargetMode.ABSOLUTE


def test_own_feature_sets(tmp_path):
    path = saved(
        tmp_path,
        """
        [task]
        targets = ["v"]
        [task.features]
        name = "rig"
        channels = ["v", "u"]
        hidden = ["p"]
        derived = [{ name = "dp", source = "p", kind = "pressure" }]
        """,
    )
    experiment = load_experiment(path)
    task = experiment.task.resolve(100.0)
    assert task.features.inputs == ("v", "u", "p")
    assert task.features.features == ("v", "u", "dp")
    assert task.derived[0].kind is Kind.PRESSURE
    assert load_experiment(saved(tmp_path, experiment_toml(experiment))).task == experiment.task


def test_signal_maps(tmp_path):
    path = saved(
        tmp_path,
        'time_unit = "ms"\n[channels.CylVels_1]\ncolumn = "v"\nunit = "mm/s"\n[channels.Load]\nkind = "force"\n'
        "[channels.BmUpConf]\nconstant = 0.0\n",
    )
    signal_map = load_signal_map(path)
    assert [entry.name for entry in signal_map.channels] == ["CylVels_1", "Load", "BmUpConf"]
    assert [entry.column for entry in signal_map.channels] == ["v", "Load", "BmUpConf"]
    assert signal_map.channels[1].kind is Kind.FORCE
    assert signal_map.channels[2].constant == 0.0
    again = build(type(signal_map), plain_tree(signal_map), "again")
    assert again == signal_map
    with pytest.raises(ConfigError, match="time_unit 'h'"):
        load_signal_map(saved(tmp_path, 'time_unit = "h"\n'))


def test_data_set_files(tmp_path):
    path = saved(
        tmp_path,
        """
        map = "map.toml"
        repair = { nan = "hold" }
        [[recordings]]
        path = "a.csv"
        rows = [10, 20]
        [[recordings]]
        path = "b.csv"
        name = "second"
        [recordings.map.channels.CylVels_1]
        column = "v"
        """,
    )
    settings = load_data_set(path)
    assert isinstance(settings, DataSetSettings)
    assert settings.map == "map.toml"
    assert settings.repair == Repair(nan="hold")
    assert settings.recordings[0].rows == (10, 20)
    assert settings.recordings[1].map.channels[0].column == "v"
    with pytest.raises(ConfigError, match=r"lists no \[\[recordings\]\]"):
        load_data_set(saved(tmp_path, 'map = "map.toml"\n'))
    with pytest.raises(ConfigError, match=r"'recordings\[0\]\.path' is missing"):
        load_data_set(saved(tmp_path, '[[recordings]]\nname = "a"\n'))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.toml' cannot be read"):
        load_experiment(tmp_path / "none.toml")
    (tmp_path / "binary.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ConfigError, match="not UTF-8"):
        load_experiment(tmp_path / "binary.toml")


def test_settings_are_frozen():
    experiment = load_experiment()
    with pytest.raises(dataclasses.FrozenInstanceError):
        experiment.training.epochs = 3
    assert not issubclass(ConfigError, DataError)
