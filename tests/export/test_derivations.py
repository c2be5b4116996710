"""Derived channels with spans in every exported form, in single precision and in integers."""

import numpy as np
import pytest

from edp.data.features import DERIVATIONS, Derived, FeatureSet
from edp.data.series import Series
from edp.data.task import TargetMode, Task
from edp.networks.backbones import TcnSpec
from edp.networks.heads import MlpHead
from edp.networks.integer import integer_predictor
from edp.networks.predictor import ModelSpec
from edp.signals import Channel, Kind
from edp.testing.networks import small_network
from edp.training import Bundle
from edp.workflows.parity import FORMS, compare, golden_case

DERIVED = tuple(
    Derived(f"{how} of {source}", source, how, span_s=span if DERIVATIONS[how].least_ticks else None)
    for how in DERIVATIONS
    for source, span in (("a", 0.03), ("load", 0.05), ("b", 0.03))
)
TASK = Task(FeatureSet("spans", ("a", "b"), DERIVED, hidden=("load",)), ("a",), (1, 3), TargetMode.DELTA, 100.0)
MODEL = ModelSpec(backbone=TcnSpec(channels=(4,), kernel=5), head=MlpHead(hidden=4), blocks=(), window=5)


def bundle_of(predictor):
    inputs = tuple(Channel(name, Kind.GENERIC, "an input") for name in TASK.inputs)
    return Bundle(predictor, inputs, (Kind.GENERIC,), ("a",))


@pytest.fixture(scope="module")
def case():
    return golden_case(bundle_of(small_network(MODEL, TASK)), 40)


@pytest.mark.parametrize("form", list(FORMS))
def test_every_form_derives_as_pytorch_does(form, case):
    rows = compare(case, [form])
    assert rows
    for row in rows:
        if row.verdict == "not run":
            pytest.skip(row.why)
        assert row.verdict == "same", row


def test_whole_numbers_are_the_same_bits_or_refused(case):
    series = Series("calibration", case.inputs, case.inputs[:, :1])
    rows = compare(golden_case(bundle_of(integer_predictor(small_network(MODEL, TASK), [series])), 40))
    assert {row.verdict for row in rows} <= {"same", "refused", "not run"}, rows
    assert "torch_ticks" in {row.form for row in rows if row.verdict == "same"}


def test_the_case_moves_every_derived_channel(case):
    assert np.ptp(case.inputs, axis=0).min() > 0
