"""The adaptation in C: the bits of its reference in NumPy, its rules, and an adversary."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edp.export import TARGETS
from edp.export.c.model import make_model
from edp.export.c.target import CTarget
from edp.export.golden import random_inputs
from edp.ir.rls import Adaptation, AdaptationSpec, RlsCorrector, RlsStatus
from edp.ir.rls.constants import CLIP, FEATURE_LIMIT, MOST_ERROR
from edp.networks.input_range import usual_range

HERE = Path(__file__).parent
NETWORKS = [("hybrid", False), ("lstm+quantiles", False), ("tcn+all", False), ("hybrid", True)]
MISSED, KEPT, DAMAGED, FROZEN, LEARN = 2.0, 3.0, 4.0, 0.0, 1.0


def adapted(bundle, **options):
    """A bundle with an adaptation as wide as its network."""
    task, predictor = bundle.task, bundle.predictor
    centre, spread = usual_range(predictor)
    columns = tuple(task.inputs.index(name) for name in task.targets)
    spec = AdaptationSpec(**({"rank": 3, "noise": 5.0, "evaluation_s": 0.3, "forgetting_s": 5.0} | options))
    shape = (len(task.horizons), len(task.targets))
    arrays = {
        "offset": centre,
        "scale": spread,
        "directions": np.random.default_rng(1).normal(size=(spec.rank, len(centre))) / 3,
        "middle": centre[list(columns)],
        "spread": spread[list(columns)],
        "change": np.full(shape, 0.7),
        "unit": np.full(shape, 0.4),
    }
    held = {name: np.asarray(values, dtype=np.float32) for name, values in arrays.items()}
    law = Adaptation(spec=spec, rate_hz=task.rate_hz, horizons=task.horizons, columns=columns, **held)
    return replace(bundle, adaptation=law)


@pytest.fixture(scope="module")
def driven(c, bundle_of, tmp_path_factory):
    """A program around an adapted network, and the bundle."""

    def make(structure, whole=False, driver="adaptation_driver.c", flags=("-O1",), **options):
        c.need("gcc")
        folder = tmp_path_factory.mktemp("adapted")
        bundle = adapted(bundle_of(structure, whole), **options)
        CTarget().write(bundle, "predictor", folder)
        sources = make_model("predictor", bundle, adapts=True).sources
        c.run("gcc", *c.flags, *flags, "-I.", *sources, HERE / driver, "-lm", "-o", "program", folder=folder)
        return bundle, folder / "program"

    return make


def fed(c, program, bundle, inputs, what):
    """The network's predictions, the adapted results as they lie in the output, and statuses."""
    rows = np.concatenate([inputs, np.asarray(what, dtype=np.float32)[:, None]], axis=1)
    found = c.run(program, feed=np.ascontiguousarray(rows, dtype=np.float32).tobytes())
    numbers = np.frombuffer(found, dtype=np.float32).reshape(len(inputs), -1)
    width = (numbers.shape[1] - 1) // 2
    return numbers[:, :width], numbers[:, width : 2 * width], numbers[:, -1].astype(int)


def hard(bundle, ticks=1200):
    """Inputs with faults, and what happens at each tick."""
    x = random_inputs(bundle.predictor, ticks, seed=4)
    what = np.full(ticks, LEARN)
    what[300:380], what[450], what[520], what[600] = FROZEN, KEPT, MISSED, DAMAGED
    x[700, 0], x[760:769] = np.nan, np.inf
    x[900:1000] = x[900]
    return x, what


@pytest.mark.parametrize(("network", "whole"), NETWORKS)
def test_c_gives_the_bits_of_the_reference(c, network, whole, driven):
    bundle, program = driven(network, whole, flags=("-O2",))
    x, what = hard(bundle)
    base, found, statuses = fed(c, program, bundle, x, what)
    law, window = bundle.adaptation, bundle.predictor.spec.window
    adapter, age, last, held = RlsCorrector(law), 0, x[0], 0
    seen = set()
    for tick in range(len(x)):
        good = what[tick] != MISSED and bool(np.isfinite(x[tick]).all())
        if good:
            last, held = x[tick], 0
        else:
            held += 1
        age = 0 if held > 5 else min(age + 1, window)
        if what[tick] == KEPT:
            learned = adapter.learned
            adapter.reset()
            adapter.restore(learned)
        if what[tick] == DAMAGED:
            adapter.theta[0, 0, 0], adapter.covariance[0, 0, 0] = np.nan, -1.0
        if age == 0:
            adapter.interrupt()
            assert statuses[tick] == RlsStatus.NONE
            continue
        y = base[tick, : law.unit.size].reshape(law.unit.shape)
        wanted, status = adapter.step(last, y, fresh=good and age >= window, learn=what[tick] != FROZEN)
        assert statuses[tick] == status, tick
        np.testing.assert_array_equal(found[tick, : law.unit.size], wanted.ravel(), err_msg=str(tick))
        seen.add(status)
    assert adapter.repairs == 2
    assert {RlsStatus.LEARNING, RlsStatus.HOLDING} <= seen


def test_bounds_of_intervals_move_with_the_prediction(c, driven):
    bundle, program = driven("lstm+quantiles")
    x = random_inputs(bundle.predictor, 400, seed=2)
    base, found, _ = fed(c, program, bundle, x, np.full(400, LEARN))
    size = bundle.adaptation.unit.size
    moved = (found - base)[20:].reshape(380, -1, size)
    assert np.abs(moved[:, 0]).max() > 0.01
    np.testing.assert_allclose(moved, np.tile(moved[:, :1], (1, moved.shape[1], 1)), atol=1e-5)


def test_its_rules_hold_under_sanitisers(c, driven):
    bundle, program = driven("hybrid", flags=("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"))
    x, what = hard(bundle)
    _, found, _ = fed(c, program, bundle, x, what)
    assert np.isfinite(found).all()


def attack(c, driven, ticks):
    # Its constants are known once the bundle is: COLUMNS and AHEAD are those of the network.
    first, _ = driven("lstm")
    law = first.adaptation
    named = {"COLUMNS": ",".join(map(str, law.columns)), "AHEAD": ",".join(map(str, law.horizons))}
    named |= {"MOST_AHEAD": f"{law.max_horizon}u", "BOUND": f"{float(law.numbers['bound']):.9g}f"}
    flags = ["-O2", "-Wno-conversion", *(f"-D{name}={value}" for name, value in named.items())]
    bundle, program = driven("lstm", driver="adversary.c", flags=flags)
    bank = random_inputs(bundle.predictor, 5_000, seed=8)
    made = c.run(program, str(ticks), feed=bank.tobytes()).decode().split()
    names = ("corrected", "worst", "not_finite", "repairs", "beyond", "without", "with", "turn", "back")
    return dict(zip(names, map(float, made), strict=True))


def held_to(found, ticks):
    assert found["corrected"] > 0.9 * ticks
    assert found["worst"] <= 1.000001
    assert (found["not_finite"], found["repairs"], found["beyond"]) == (0, 0, 0)
    assert found["with"] <= 1.05 * found["without"]
    assert found["turn"] <= 1.2


def test_an_adversary_does_not_break_its_bounds(c, driven):
    held_to(attack(c, driven, 480_000), 480_000)


@pytest.mark.slow
def test_an_adversary_does_not_break_its_bounds_in_a_day(c, driven):
    held_to(attack(c, driven, 8_640_000), 8_640_000)


def test_constants_of_the_runtime_are_those_of_the_reference():
    text = (HERE.parents[1] / "src/edp/export/c/runtime/edp_adaptation.h").read_text()
    found = dict(re.findall(r"#define EDP_ADAPT_(\w+) ([\d.]+)f", text))
    wanted = {"FEATURE_LIMIT": FEATURE_LIMIT, "CLIP": CLIP, "MOST_ERROR": MOST_ERROR}
    assert {name: float(value) for name, value in found.items()} == wanted


def test_deviations_from_misra_are_among_those_that_the_docs_list(c, bundle_of, tmp_path):
    c.need("cppcheck")
    CTarget().write(adapted(bundle_of("hybrid")), "predictor", tmp_path)
    options = ("--std=c99", "--addon=misra", "--enable=style", "--quiet", "--output-file=found.txt")
    c.run("cppcheck", *options, "predictor_adaptation.c", "edp_adaptation.c", folder=tmp_path)
    found = set(re.findall(r"\[misra-c2012-([\d.]+)\]", (tmp_path / "found.txt").read_text()))
    assert found <= {"8.9", "12.1", "18.4", "2.4", "2.5"}


def test_only_c_holds_it_and_a_network_without_it_is_as_before(bundle_of, tmp_path):
    bundle = bundle_of("hybrid")
    with_ = {path.name for path in CTarget().write(adapted(bundle), "predictor", tmp_path / "with")}
    plain = {path.name for path in CTarget().write(bundle, "predictor", tmp_path / "plain")}
    own = {"predictor_adaptation.h", "predictor_adaptation.c", "edp_adaptation.h", "edp_adaptation.c"}
    assert with_ - plain == own
    assert "adaptation" not in (tmp_path / "plain/CMakeLists.txt").read_text()
    same = [name for name in plain if name != "CMakeLists.txt"]
    assert all((tmp_path / "with" / n).read_bytes() == (tmp_path / "plain" / n).read_bytes() for n in same)
    assert [name for name in TARGETS if getattr(TARGETS[name], "adapts", False)] == ["c"]


def test_its_cmake_file_builds_it(c, bundle_of, tmp_path):
    c.need("cmake", "gcc")
    CTarget().write(adapted(bundle_of("hybrid", True), rank=0), "predictor", tmp_path)
    c.run("cmake", "-S", tmp_path, "-B", tmp_path / "build")
    c.run("cmake", "--build", tmp_path / "build")
