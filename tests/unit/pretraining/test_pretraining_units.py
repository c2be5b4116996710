"""A pretraining as a unit of work leaves the run that this process reads."""

import pytest

from edp.jobs.workers import IN_PROCESS, WorkUnit
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.workflows.pretraining import Pretrain, pretrain

pytestmark = pytest.mark.processes


def test_a_pretraining_elsewhere_is_that_of_this_process(machines, experiment, tmp_path):
    where = {"source": machines, "experiment": experiment, "order": Pretrain(), "out": str(tmp_path / "there")}
    unit = WorkUnit("edp.workflows.pretraining.pretrain:pretrain_unit", "there", {}, where=where)
    assert [result.values for _, result in IN_PROCESS.map([unit])] == [{}]
    assert pretrain(machines, experiment, Pretrain(), tmp_path / "there") == pretrain(
        machines, experiment, Pretrain(), tmp_path / "here"
    )
    first, second = (load_bundle(tmp_path / name).predictor for name in ("there", "here"))
    assert weights_digest(first) == weights_digest(second)
