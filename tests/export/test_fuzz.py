"""Exported C under a fuzzer: no bytes make it break the rules of its header or the rules of C."""

from __future__ import annotations

import copy
import re
import shutil
import subprocess
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from edp.export.c.target import CTarget
from edp.networks.input_range import usual_range

ADDRESSES = "-fsanitize=fuzzer,address,undefined,float-cast-overflow"
UNINITIALISED = "-fsanitize=fuzzer,memory"
SHORT = ["hybrid+all", "tcn+quantiles"]


@pytest.fixture(scope="session")
def fuzzing(c, tmp_path_factory):
    """Builds fuzzers and runs them; tests are skipped where Clang or its fuzzer is missing."""
    c.need("clang")
    folder = tmp_path_factory.mktemp("probe")
    (folder / "probe.c").write_text("int LLVMFuzzerTestOneInput(const char *d, unsigned long n) { return d && n < 0; }")
    probed = subprocess.run(["clang", "-fsanitize=fuzzer", "probe.c"], cwd=folder, capture_output=True)
    if probed.returncode:
        pytest.skip("needs the Debian package libclang-rt-dev (make system-packages)")

    def build(folder, sanitiser=ADDRESSES):
        flags = [*c.flags, "-O1", "-g", sanitiser, "-fno-sanitize-recover=all"]
        c.run("clang", *flags, "fuzz.c", *c.sources(folder), "-lm", "-o", "fuzzer", folder=folder)

    def run(folder, runs, *more):
        command = ["./fuzzer", f"-runs={runs}", "-seed=1", "-max_len=400", "-artifact_prefix=found-", *more]
        return subprocess.run(command, cwd=folder, capture_output=True, text=True)

    return SimpleNamespace(build=build, run=run)


def clean(done):
    assert done.returncode == 0, done.stderr[-2000:]
    assert "DONE" in done.stderr


@pytest.mark.parametrize(
    ("network", "whole"),
    [
        ("hybrid+all", False),
        ("tcn+quantiles", True),
        pytest.param("tcn+quantiles", False, marks=pytest.mark.slow),
        pytest.param("hybrid", True, marks=pytest.mark.slow),
    ],
)
def test_nothing_is_found_in_a_short_run(network, whole, bundle_of, fuzzing, tmp_path):
    CTarget().write(bundle_of(network, whole), "predictor", tmp_path)
    fuzzing.build(tmp_path)
    clean(fuzzing.run(tmp_path, 200))


@pytest.mark.slow
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("sanitiser", [ADDRESSES, UNINITIALISED])
def test_nothing_is_found_in_a_long_run(c, structure, sanitiser, whole, bundle_of, fuzzing, tmp_path):
    CTarget().write(bundle_of(structure, whole), "predictor", tmp_path)
    fuzzing.build(tmp_path, sanitiser)
    clean(fuzzing.run(tmp_path, 5_000))


def hot(bundle):
    """A network whose sums overflow for the largest inputs that are accepted, and not for usual ones."""
    predictor = copy.deepcopy(bundle.predictor)
    with torch.no_grad():
        for name, weight in predictor.named_parameters():
            if "weight_ih" in name:
                weight.mul_(1e33)
    return replace(bundle, predictor=predictor)


def test_numbers_that_overflow_inside_end_in_a_restart(bundle_of, fuzzing, tmp_path):
    """The fuzzer found NaN converted to an integer in the exponential of such a network, which C leaves undefined."""
    bundle = hot(bundle_of("gru"))
    CTarget().write(bundle, "predictor", tmp_path)
    fuzzing.build(tmp_path)
    clean(fuzzing.run(tmp_path, 1_500))
    centre, spread = usual_range(bundle.predictor)
    assert (abs(centre) + 1e6 * spread).max() * 1e33 > 3.4e38


def test_what_is_not_a_number_stays_so(c, tmp_path, bundle_of):
    c.need("gcc")
    CTarget().write(bundle_of("lstm"), "predictor", tmp_path)
    (tmp_path / "nan.c").write_text("""
#include "edp_runtime.h"
#include <math.h>
int main(void) {
    float x[3] = {NAN, -INFINITY, -1.0f};
    edp_map_relu(x, 3u, x);
    const bool kept = isnan(edp_exp(NAN)) && isnan(edp_tanh(NAN)) && isnan(edp_sigmoid(-NAN)) && isnan(x[0]);
    const bool ends = (edp_tanh(-INFINITY) == -1.0f) && (edp_sigmoid(INFINITY) == 1.0f) && (edp_exp(-1e30f) > 0.0f);
    return (kept && ends && (x[1] == 0.0f) && (x[2] == 0.0f)) ? 0 : 1;
}
""")
    c.run("gcc", *c.flags, "-O2", "nan.c", "edp_runtime.c", "-lm", "-o", "nan", folder=tmp_path)
    c.run(tmp_path / "nan")


VALID = "edp_valid(in, input_low, input_high, PREDICTOR_INPUTS)"
HELD = "status = EDP_RESTARTED;\n    if ((s->age"
PLANTED = {
    "inputs that are not finite are": (VALID, f"({VALID} || (in[0] != in[0]))"),
    "predictions are finite": ("bool finite = ", "bool finite = (s->age > 2u) || "),
    "left alone": (HELD, HELD.replace(";", "; out->prediction[0][0] += 1.0f;", 1)),
    "equal states": (
        "s->ticks++;\n    if (c",
        "static float n; s->last[0] += (n += 1e-6f);\n    s->ticks++;\n    if (c",
    ),
    "a reset forgets everything": (
        "    s->marker = MARKER;",
        "    if (s->marker == MARKER) return;\n    s->marker = MARKER;",
    ),
}
"""Lines of the model by the rule that their faulty form breaks."""


FAST = "equal states"


@pytest.mark.parametrize("rule", [pytest.param(x, marks=() if x == FAST else pytest.mark.slow) for x in PLANTED])
def test_a_planted_fault_is_found_and_can_be_replayed(c, rule, bundle_of, fuzzing, tmp_path):
    bundle = hot(bundle_of("gru")) if rule == "predictions are finite" else bundle_of("lstm")
    CTarget().write(bundle, "predictor", tmp_path)
    model = (tmp_path / "predictor.c").read_text()
    right, wrong = PLANTED[rule]
    assert right in model
    (tmp_path / "predictor.c").write_text(model.replace(right, wrong))
    fuzzing.build(tmp_path)
    done = fuzzing.run(tmp_path, 5_000)
    assert done.returncode != 0
    assert rule in done.stderr, done.stderr[-1000:]
    (found,) = tmp_path.glob("found-*")
    c.need("gcc")
    c.run("gcc", *c.flags, "-O1", "-DREPLAY", "fuzz.c", *c.sources(tmp_path), "-lm", "-o", "replay", folder=tmp_path)
    again = subprocess.run(["./replay", found.name], cwd=tmp_path, capture_output=True, text=True)
    assert again.returncode != 0
    assert rule in again.stderr
    (tmp_path / "predictor.c").write_text(model)
    c.run("gcc", *c.flags, "-O1", "-DREPLAY", "fuzz.c", *c.sources(tmp_path), "-lm", "-o", "replay", folder=tmp_path)
    assert b"every rule held" in c.run("./replay", found.name, folder=tmp_path)


ZONE = "    float zone_{0}[2]; /* NaN */"


def with_zones(header):
    """The header with two numbers behind each array of the state, and their names."""
    start = header.index("Not to be touched")
    stop = header.index("} predictor_state;")
    lines, names = [], []
    for line in header[start:stop].splitlines():
        lines.append(line)
        if re.match(r"    float \w+\[\d+u?\];", line) or "float last[" in line:
            names.append(f"zone_{len(names)}")
            lines.append(f"    float {names[-1]}[2];")
    return header[:start] + "\n".join(lines) + "\n" + header[stop:], names


def check_zones(c, structure, bundle_of, folder):
    """Golden predictions with NaN behind every array: who reads one predicts NaN, who writes one is seen."""
    c.need("gcc")
    CTarget().write(bundle_of(structure), "predictor", folder)
    header, names = with_zones((folder / "predictor.h").read_text())
    assert len(names) >= 2
    (folder / "predictor.h").write_text(header)
    test = (folder / "host_test.c").read_text()
    fill = "\n".join(f"    state.{name}[0] = state.{name}[1] = NAN;" for name in names)
    seen = " && ".join(f"isnan(state.{name}[0]) && isnan(state.{name}[1])" for name in names)
    test = test.replace("    compare();\n    rules();", f'{fill}\n    compare();\n    expect({seen}, "zones");')
    assert "zones" in test
    test = test.replace("static void rules(void)", "void rules(void);\nvoid rules(void)")
    (folder / "host_test.c").write_text(test)
    c.run("gcc", *c.flags, "-O1", "host_test.c", *c.sources(folder), "-lm", "-o", "program", folder=folder)
    assert b"all tests passed" in c.run("./program", folder=folder)


@pytest.mark.parametrize("network", [*SHORT, "hybrid9", "lstm+all"])
def test_no_layer_reads_or_writes_beside_its_memory(c, network, bundle_of, tmp_path):
    check_zones(c, network, bundle_of, tmp_path)


@pytest.mark.slow
def test_no_layer_of_any_network_reads_or_writes_beside_its_memory(c, structure, bundle_of, tmp_path):
    check_zones(c, structure, bundle_of, tmp_path)


def test_its_cmake_file_builds_the_fuzzer(c, bundle_of, fuzzing, tmp_path):
    c.need("cmake")
    CTarget().write(bundle_of("lstm"), "predictor", tmp_path)
    build = tmp_path / "fuzzing"
    c.run("cmake", "-S", tmp_path, "-B", build, "-DCMAKE_C_COMPILER=" + shutil.which("clang"), "-DFUZZ=ON")
    c.run("cmake", "--build", build, "--target", "predictor_fuzz")
    c.run(build / "predictor_fuzz", "-runs=20", "-seed=1")
