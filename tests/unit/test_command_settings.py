"""Tables of commands: a file, changes over it, and what goes on to the trainings."""

from dataclasses import replace

import pytest

from edp.config.commands import TRAINING_TABLES, command_settings
from edp.config.experiment import load_experiment
from edp.errors import ConfigError
from edp.workflows.compression import DISTIL_SETTINGS, DistilSpec
from edp.workflows.transfer import FinetuneSpec

FILE = """
[finetune]
single_phase_epochs = 20
batch = 16

[training]
updates = 7
loss = { kind = "mse" }
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "settings.toml"
    path.write_text(FILE)
    return path


def test_a_file_lies_over_the_defaults_and_changes_over_the_file(file):
    spec, others = command_settings("finetune", FinetuneSpec, file, ["finetune.batch=8"], TRAINING_TABLES)
    assert spec == replace(FinetuneSpec(), single_phase_epochs=20, batch=8)
    assert others == ({"training": {"updates": 7, "loss": {"kind": "mse"}}},)
    assert command_settings("finetune", FinetuneSpec) == (FinetuneSpec(), ())


def test_what_is_not_the_commands_own_goes_on_in_its_order(file):
    changes = ["training.updates=9", "finetune.single_phase_epochs=3", {"training": {"updates": 11}}]
    spec, others = command_settings("finetune", FinetuneSpec, file, changes, TRAINING_TABLES)
    assert spec.single_phase_epochs == 3
    assert [layer["training"]["updates"] for layer in others] == [7, 11]
    experiment = load_experiment(file, "quick", changes, aside=("finetune",))
    assert experiment.training.updates == 11
    assert experiment == load_experiment(None, "quick", others)


def test_a_table_of_another_command_is_refused_by_name(file):
    with pytest.raises(ConfigError, match=r"'.*settings\.toml': unknown key 'training'; known: finetune"):
        command_settings("finetune", FinetuneSpec, file)
    with pytest.raises(ConfigError, match="unknown key 'finetun'; did you mean 'finetune'"):
        command_settings("finetune", FinetuneSpec, None, ["finetun.single_phase_epochs=3"], TRAINING_TABLES)
    with pytest.raises(ConfigError, match=r"did you mean 'finetune\.single_phase_epochs'"):
        command_settings("finetune", FinetuneSpec, None, ["single_phase_epochs=3"])


def test_all_problems_of_a_table_are_told_at_once_with_their_path():
    changes = ["finetune.single_phase_epoch=3", "finetune.batch=many", "finetune.center=1"]
    with pytest.raises(ConfigError) as caught:
        command_settings("finetune", FinetuneSpec, None, changes)
    text = str(caught.value)
    assert "3 problems" in text
    assert "unknown key 'finetune.single_phase_epoch'; did you mean 'single_phase_epochs'" in text
    assert "finetune.batch = 'many'" in text
    assert "finetune.center = 1: write true or false" in text
    with pytest.raises(ConfigError, match=r"1 problem\n  - finetune: epochs = 0; integers, 1 <= epochs"):
        command_settings("finetune", FinetuneSpec, None, ["finetune.epochs=0"])
    with pytest.raises(ConfigError, match="finetune: expected a table, got 3"):
        command_settings("finetune", FinetuneSpec, None, ["finetune=3"])


def test_a_table_may_hold_registered_parts():
    changes = ['distil.objective={distillation_loss={kind="mse"}, target_weight=0.2}', "distil.units=8"]
    spec, _ = command_settings("distil", DistilSpec, None, changes, tree=DISTIL_SETTINGS)
    assert (spec.units, spec.objective.target_weight, type(spec.objective.distillation_loss).__name__) == (
        8,
        0.2,
        "MeanSquared",
    )
    with pytest.raises(ConfigError, match=r"'distil\.units' is missing"):
        command_settings("distil", DistilSpec, None, (), tree=DISTIL_SETTINGS)
