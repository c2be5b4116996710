"""The copy for optuna-dashboard says what the study found, and nothing else of the study is touched."""

import json

import optuna
import pytest
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import TrialState

from edp.errors import ConfigError, StorageError
from edp.evaluation.study import Decision, SessionSets, StudyData, StudyFile
from edp.evaluation.study_facts import CalibratedBackbone, CalibrationFacts, SynthesisFacts, TrialRow
from edp.workflows.search.export import export_study
from edp.workflows.search.plan import space_of
from edp.workflows.search.space import Choice, Real

SPACE = {"learning_rate": {"low": 1e-4, "high": 5e-3, "log": True}, "units": [8, 16]}
RATES = ({"learning_rate": 1e-3, "units": 8}, {"learning_rate": 2e-3, "units": 16})
TRIALS = (
    TrialRow(number=0, values=RATES[0], score=12.5, mae=3.5, parameters=100.0, statuses=("done",)),
    TrialRow(number=1, values=RATES[1], score=None, mae=None, parameters=300.0, statuses=("oom",)),
)
JOINT = TrialRow(number=0, values={"learning_rate": 1e-3}, modules=("stanh",), score=11.0, mae=None, parameters=101.0)


def study(folder, cost="none", decisions=True):
    lstm = CalibratedBackbone(**vars(TRIALS[0]), trials=TRIALS)
    calibration = CalibrationFacts(backbones={"lstm": lstm}, backbone="lstm", baseline=RATES[0], settings={})
    synthesis = SynthesisFacts(
        settings={},
        values={},
        modules=("stanh",),
        score=11.0,
        costs={},
        on={"stanh": 1.0, "zoneout": 0.0},
        trials=(JOINT,),
        said_of_pruned=(),
        test={},
        test_gain=None,
        antagonistic=(),
    )
    file = StudyFile(
        state="finished",
        mode="sound",
        unit="bar",
        preset="quick",
        data=StudyData("logs", 2, 1.0, "00"),
        spec={"space": SPACE, "cost": cost},
        sessions=SessionSets((), ()),
        modules={},
        decisions=(Decision("calibration", calibration, ()), Decision("synthesis", synthesis, ())) if decisions else (),
        phases=(),
        history=(),
        openings=(),
    )
    (folder / "study.json").write_text(json.dumps(file.to_json()))
    return folder


def loaded(file, name):
    return optuna.load_study(study_name=name, storage=JournalStorage(JournalFileBackend(str(file))))


def test_questions_and_answers_come_back(tmp_path):
    file, names = export_study(study(tmp_path))
    assert (file.name, names) == ("optuna.journal", ["calibration lstm", "synthesis"])
    first, second = loaded(file, "calibration lstm").trials
    assert (first.params, first.value) == (RATES[0], 12.5)
    assert first.user_attrs == {"mae": 3.5, "parameters": 100.0}
    assert second.state is TrialState.FAIL
    (joint,) = loaded(file, "synthesis").trials
    assert joint.params == {"learning_rate": 1e-3, "stanh": 1, "zoneout": 0}
    assert loaded(file, "synthesis").user_attrs["objectives"] == ["composite, bar"]


def test_a_second_export_replaces_the_first_and_leaves_nothing_beside_it(tmp_path):
    export_study(study(tmp_path))
    file, names = export_study(tmp_path)
    storage = JournalStorage(JournalFileBackend(str(file)))
    assert sorted(optuna.get_all_study_names(storage)) == names
    assert sorted(path.name for path in tmp_path.iterdir()) == ["optuna.journal", "study.json"]


def test_a_cost_is_a_second_objective(tmp_path):
    file, _ = export_study(study(tmp_path, cost="parameters"), tmp_path / "copy.journal")
    held = loaded(file, "calibration lstm")
    assert held.trials[0].values == [12.5, 100.0]
    assert held.user_attrs["objectives"] == ["composite, bar", "parameters"]


def test_a_study_that_has_asked_nothing_and_a_folder_without_one(tmp_path):
    with pytest.raises(StorageError, match=r"asked no questions yet: phase 1"):
        export_study(study(tmp_path, decisions=False))
    assert not (tmp_path / "optuna.journal").exists()
    with pytest.raises(StorageError, match="holds no study"):
        export_study(tmp_path / "nowhere")


def test_a_space_comes_back_from_its_plain_form():
    found = space_of(SPACE)
    assert found == {"learning_rate": Real(1e-4, 5e-3, log=True), "units": Choice((8, 16))}
    with pytest.raises(ConfigError, match="unknown dimension"):
        space_of({"unit": [1, 2]})
