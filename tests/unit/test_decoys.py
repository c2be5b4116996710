"""The decoys that the screening benchmark lays over logs, and the simulator's own word on what matters."""

import importlib.util
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from edp.signals import TABLE_A1
from edp.sim import Scenario, simulate

FOLDER = Path(__file__).parents[2] / "benchmarks"


def load(name):
    spec = importlib.util.spec_from_file_location(f"bench_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def plan():
    kinds = ("combined", "aprbs", "end_stops")
    return [Scenario(excitation=kind, duration_s=12.0, seed=n, name=f"m22_{n}") for n, kind in enumerate(kinds)]


@pytest.fixture(scope="module")
def recordings(plan):
    return [simulate(scenario) for scenario in plan]


@pytest.fixture(scope="module")
def laid(recordings):
    return load("decoys").lay_decoys(recordings, each=20, seed=3)


def test_eighty_decoys_lie_behind_the_channels(recordings, laid):
    with_decoys, decoys = laid
    assert Counter(decoy.family for decoy in decoys) == {"noise": 20, "copy": 20, "leak": 20, "artefact": 20}
    assert len({decoy.name for decoy in decoys}) == 80
    for before, after in zip(recordings, with_decoys, strict=True):
        assert after.channel_names == before.channel_names + tuple(decoy.name for decoy in decoys)
        assert np.array_equal(after.select(before.channel_names), before.values)
        assert np.isfinite(after.values).all()
    again, _ = load("decoys").lay_decoys(recordings, each=20, seed=3)
    assert [r.digest for r in again] == [r.digest for r in with_decoys]


def test_copies_follow_and_leaks_run_ahead(laid):
    recordings, decoys = laid
    for decoy in decoys:
        if decoy.lead and "filter" not in decoy.recipe:
            x = recordings[0].column(decoy.name).astype(float)
            y = recordings[0].column(decoy.source).astype(float)
            a, b = (x[: -decoy.lead], y[decoy.lead :]) if decoy.lead > 0 else (x[-decoy.lead :], y[: decoy.lead])
            if y.std() > 0:
                assert abs(np.corrcoef(a, b)[0, 1]) > 0.9, decoy


def test_relations_of_artefacts_do_not_hold_over_files(laid):
    recordings, decoys = laid
    turned = [decoy for decoy in decoys if "another sign" in decoy.recipe]
    assert turned
    for decoy in turned:
        signs = [np.corrcoef(r.column(decoy.name), r.column(decoy.source))[0, 1] for r in recordings]
        assert min(signs) < -0.3
        assert max(signs) > 0.3


def test_the_simulator_says_what_matters(plan, recordings):
    found = {cause.name: cause for cause in load("m22_truth").causes(plan, recordings, moments=3)}
    assert list(found) == list(TABLE_A1)
    for name, cause in found.items():
        if name.startswith("CylAcc"):
            assert cause.effect_mm_s == (0.0, 0.0, 0.0)
            assert cause.given_by == (name.replace("Acc", "Vels"),)
        elif name.endswith("Conf"):
            assert cause.given_by == (name.removesuffix("Conf"),)
        else:
            assert not cause.given_by
        if name.startswith(("CylVels", "CylPressures")):
            assert cause.needed
    # The boom's second spool is hardly moved downwards, and stays in its dead band.
    assert not found["BmDwnConf"].matters
    assert found["BmUp"].needed
