"""Fits use one thread of NumPy's linear algebra, and leave the caller's threads as they were."""

import os

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from edp.cli.threads import VARIABLE, use_one_blas_thread
from edp.training.blas import one_blas_thread
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


@pytest.mark.parametrize("fit", [train_auto, train, evaluate, train_twin])
def test_trainings_and_their_evaluation_are_wrapped(fit):
    # `contextmanager` as a decorator keeps the function that it runs.
    assert fit.__wrapped__.__name__ == fit.__name__


def test_commands_and_their_children_use_one_unless_the_environment_says_how_many(monkeypatch):
    with threadpool_limits(limits=2, user_api="blas"):
        monkeypatch.setenv(VARIABLE, "2")
        use_one_blas_thread()
        assert threads() == {2}
        monkeypatch.delenv(VARIABLE)
        use_one_blas_thread()
        assert threads() == {1}
        assert os.environ[VARIABLE] == "1"
