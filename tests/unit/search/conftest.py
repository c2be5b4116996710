"""Trainings for the ledger and the executors, small enough to kill by the dozen."""

from pathlib import Path

import pytest

from edp.jobs.base import Job
from edp.storage.ledger import TrainingIdentity


@pytest.fixture
def identity_of():
    def make(seed=0, job="train", **config):
        name = f"trainings_of_tests:{job}"
        facts = {"code": "c", "data": "d", "environment": {"threads": "1"}}
        return TrainingIdentity(name, config, {"fold": 0}, seed, 1, **facts)

    return make


@pytest.fixture
def job_of(identity_of, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parent)

    def make(seed=0, job="train", seconds=None, memory_mb=None, **config):
        where = {"log": str(tmp_path / "log")}
        return Job(identity_of(seed, job, **config), where, seconds, memory_mb)

    return make


@pytest.fixture
def log(tmp_path):
    """How often a word stands in the log of the trainings."""

    def count(word):
        file = tmp_path / "log"
        return file.read_text().count(word) if file.exists() else 0

    return count
