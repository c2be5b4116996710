"""Files that a stopped run continues from may be changed by hand: each damage is one message, never a traceback."""

import numpy as np
import pytest

from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.tasks import TASKS
from edp.errors import StorageError
from edp.storage import write_json
from edp.storage.arrays import numbers_in
from edp.storage.runs import Run
from edp.workflows.control import ControlBench, ControlSources, TuningSpec, tune_gains
from edp.workflows.identify.identify import _read_stage

HOSTILE = ["x", ["x"], [[1.0], [1.0, 2.0]], [None], [float("nan")], [1e400], {"a": 1}, [True, {}], [10**400]]


@pytest.mark.parametrize("value", HOSTILE, ids=range(len(HOSTILE)))
def test_numbers_of_a_file_are_finite_numbers(value):
    with pytest.raises(StorageError, match="finite numbers"):
        numbers_in(value, "'file'")


def test_numbers_come_back_to_the_bit():
    values = np.random.default_rng(0).standard_normal((3, 4))
    assert np.array_equal(numbers_in(values.tolist(), "'file'"), values)


@pytest.fixture
def tune(tmp_path, monkeypatch):
    monkeypatch.setattr(ControlBench, "check", lambda bench: None)
    monkeypatch.setattr(ControlBench, "cost", lambda bench, spec, divided: 1.0)
    monkeypatch.setattr(ControlBench, "costs", lambda bench, spec, divided: {"a": 1.0})
    experiment = ControlExperiment(task=TASKS["grade"](), controller=CONTROLLERS["pi"](), loops=1)
    spec = TuningSpec(trials=2, loops=1, sampler="random")
    return lambda: tune_gains(experiment, tmp_path / "run", ControlSources(), ControlSources(), spec)


@pytest.mark.parametrize("gains", [{}, [], "x", None, {name: [1.0, 2.0] for name in CONTROLLERS["pi"]().space}])
def test_a_finished_tuning_with_other_gains_is_refused(tune, tmp_path, gains):
    tune()
    file = tmp_path / "run" / "tuning.json"
    write_json(file, {"controller": "pi", "gains": gains, "trials": [], "judged_mm": {}})
    with pytest.raises(StorageError, match=r"tuning\.json"):
        tune()


@pytest.mark.parametrize("theta", [[1.0], [[1.0, 2.0]], "x"])
def test_a_stage_of_another_shape_is_refused(tmp_path, theta):
    with Run(tmp_path / "run", "identification") as run:
        write_json(run.file("machine.json"), {"theta": theta})
        with pytest.raises(StorageError, match=r"machine\.json"):
            _read_stage(run, "machine", {"theta": (2,)})
