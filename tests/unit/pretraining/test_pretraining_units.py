"""A pretraining as a unit of work leaves the run that one process leaves."""

from edp.jobs import Workforce
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.workflows.fleet.training import pretrain_with
from edp.workflows.pretraining import Pretrain, pretrain


def test_a_pretraining_elsewhere_is_that_of_this_process(machines, experiment, tmp_path):
    there = pretrain_with(Workforce(), machines, experiment, Pretrain(), tmp_path / "there")
    here = pretrain(machines, experiment, Pretrain(), tmp_path / "here")
    assert there == here
    first, second = (load_bundle(tmp_path / name).predictor for name in ("there", "here"))
    assert weights_digest(first) == weights_digest(second)
    again = pretrain_with(Workforce(), machines, experiment, Pretrain(), tmp_path / "there")
    assert again == here
