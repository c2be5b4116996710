"""Fits use one thread of NumPy's linear algebra, and leave the caller's threads as they were."""

import os
import sys

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from edp.cli.process import VARIABLE, use_one_blas_thread
from edp.config.experiment import load_experiment
from edp.config.twin import TwinExperiment
from edp.training.blas import one_blas_thread
from edp.workflows import train_evaluate
from edp.workflows.auto.train_auto import train_auto
from edp.workflows.train_evaluate import evaluate, train
from edp.workflows.twin.train_twin import train_twin


def threads():
    np.ones((2, 2)) @ np.ones((2, 2))
    return {entry["num_threads"] for entry in threadpool_info() if entry["user_api"] == "blas"}


@pytest.mark.parametrize("as_decorator", [False, True])
def test_within_there_is_one_and_behind_what_was_before(as_decorator):
    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        if as_decorator:
            within = one_blas_thread()(threads)()
        else:
            with one_blas_thread():
                within = threads()
        assert within == {1}
        assert threads() == before


class Told(Exception):
    """What stops a workflow at its first look at the recordings."""


class Recordings:
    """Stands for logs; says how many threads there were when it was read."""

    def read(self):
        raise Told(*threads())


@pytest.mark.parametrize("fit", [train, train_twin], ids=["train", "twin"])
def test_trainings_read_their_recordings_within_one_thread(fit, tmp_path):
    experiment = TwinExperiment() if fit is train_twin else load_experiment(overrides=["task.targets=['a']"])
    with threadpool_limits(limits=2, user_api="blas"):
        with pytest.raises(Told) as told:
            fit(Recordings(), experiment, tmp_path / "run")
        assert told.value.args == (1,)
        assert threads() == {2}


def test_the_preset_auto_and_evaluations_run_within_one_thread(tmp_path, monkeypatch):
    def tell(*_, **__):
        raise Told(*threads())

    # By its module: the package gives the function under the same name.
    monkeypatch.setattr(sys.modules[train_auto.__module__], "ReadOnce", tell)
    monkeypatch.setattr(train_evaluate, "read_trained_run", tell)
    with threadpool_limits(limits=2, user_api="blas"):
        for call in (lambda: train_auto(Recordings(), None, tmp_path), lambda: evaluate(tmp_path)):
            with pytest.raises(Told) as told:
                call()
            assert told.value.args == (1,)


def test_commands_and_their_children_use_one_unless_the_environment_says_how_many(monkeypatch):
    with threadpool_limits(limits=2, user_api="blas"):
        monkeypatch.setenv(VARIABLE, "2")
        use_one_blas_thread()
        assert threads() == {2}
        monkeypatch.delenv(VARIABLE)
        use_one_blas_thread()
        assert threads() == {1}
        assert os.environ[VARIABLE] == "1"
