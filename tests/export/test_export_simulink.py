"""The blocks for Simulink as C: S-function and C Caller against stand-ins of Simulink's headers, and their rules."""

from __future__ import annotations

import ctypes
import json
import shutil
import subprocess
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from edp.errors import ConfigError, ExportError
from edp.export import make_target
from edp.export.c.model import make_model
from edp.export.golden import random_inputs, stream, tolerance
from edp.export.simulink.folder import Folder
from edp.export.simulink.native import Native
from edp.export.simulink.target import SimulinkTarget
from edp.ir import Graph, Layer

STRICT = ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-O1")
HEAP = {"malloc", "calloc", "realloc", "free", "alloca"}


class Strange(Layer):
    @property
    def width(self):
        return 1


def test_what_cannot_be_written_is_refused_by_name(bundle_of, tmp_path):
    graph = Graph(1, (Strange(name="odd.one", inputs=("input",)),), {"prediction": "odd.one"})
    with pytest.raises(ExportError, match=r"layer 'odd\.one' is a Strange, which has no form in MATLAB; .* Accumulate"):
        Native(graph).code()
    with pytest.raises(ExportError, match=r"21 characters; .* at most 20"):
        SimulinkTarget().write(bundle_of("lstm"), "a" * 21, tmp_path)
    with pytest.raises(ExportError, match="--name"):
        SimulinkTarget().write(bundle_of("lstm"), "Arm", tmp_path)
    with pytest.raises(ExportError, match="opset 12"):
        make_target("simulink", {"opset": "12"})
    with pytest.raises(ConfigError, match="'maybe'; it must be true or false"):
        make_target("simulink", {"window": "maybe"})
    assert not list(tmp_path.iterdir())


def test_files_are_the_same_each_time_and_described(bundle_of, matlab_folder_of, tmp_path):
    folder, bundle = matlab_folder_of("hybrid+quantiles"), bundle_of("hybrid+quantiles")
    files = SimulinkTarget().write(bundle, "arm", tmp_path)
    assert files[0].name == "README.md"
    for file in files:
        assert file.read_bytes() == (folder / file.relative_to(tmp_path)).read_bytes()
    described = json.loads((folder / "arm.json").read_text())
    read = scipy.io.loadmat(folder / "arm.mat", simplify_cells=True)
    assert [entry["name"] for entry in described["inputs"]] == list(bundle.task.inputs)
    assert [entry["field"] for entry in read["edp"]["inputs"]] == [entry["field"] for entry in described["inputs"]]
    assert {"rules", "status", "model_hash", "rate_hz", "window", "mode"} <= set(described) == set(read["edp"])
    assert described["status"] == ["ok", "warming", "held", "restarted", "not_reset"]
    readme = files[0].read_text()
    assert all(f"`{file.name}`" in readme for file in files if file.parent == tmp_path and file.suffix != ".md")
    assert "Not checked, for want of MATLAB" in readme
    assert all(line.count("|") == 4 for line in readme.splitlines() if line.startswith("| `"))


def test_without_the_window_and_in_whole_numbers(bundle_of, matlab_folder_of, tmp_path):
    files = {file.name for file in SimulinkTarget(window=False).write(bundle_of("lstm"), "arm", tmp_path)}
    assert "arm_step.m" in files
    assert not files & {"arm_onnx.m", "arm_window.onnx"}
    folder = matlab_folder_of("hybrid", True)
    there = {file.name for file in folder.iterdir()}
    assert {"arm_sfun.c", "arm_call.c", "arm_golden.m"} <= there
    assert not there & {"arm_step.m", "arm_reset.m", "arm_stream.m", "arm_onnx.m", "arm_window.onnx"}
    assert "integer arithmetic: C code only" in (folder / "README.md").read_text()


@pytest.fixture(scope="session")
def blocks(c, matlab_folder_of, tmp_path_factory):
    """Programs that run a network's S-function, and libraries with its C Caller function."""

    @cache
    def make(structure: str, whole: bool = False) -> tuple[Path, Path]:
        c.need("gcc")
        folder, made = matlab_folder_of(structure, whole), tmp_path_factory.mktemp("blocks")
        core = sorted((folder / "core").glob("*.c"))
        places = ("-I", folder / "octave", "-I", folder / "core")
        sources = [folder / "arm_sfun.c", folder / "octave/stub_main.c"]
        c.run("gcc", *STRICT, "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-DSFUN=arm_sfun",
              *places, *sources, *core, "-lm", "-o", made / "sfun")  # fmt: skip
        c.run("gcc", *STRICT, "-shared", "-fPIC", *places, folder / "arm_call.c", *core, "-lm", "-o", made / "call.so")
        return made / "sfun", made / "call.so"

    return make


class Block:
    """Runs the S-function over rows."""

    def __init__(self, program, predictor, shapes):
        self.program, self.period = program, 1 / predictor.task.rate_hz
        self.numbers = sum(rows * columns for rows, columns in shapes.values())

    def __call__(self, rows, times=None, blocks=0, minor=0, resets=0, period=None):
        ticks = len(rows)
        head = np.zeros((ticks, 4))
        head[:, 0], head[:, 2], head[:, 3] = blocks, minor, resets
        head[:, 1] = np.arange(ticks) * self.period if times is None else times
        given = np.hstack([head, rows]).tobytes()
        done = subprocess.run([self.program, repr(period or self.period)], input=given, capture_output=True)
        found = np.frombuffer(done.stdout).reshape(-1, self.numbers + 5)
        return found[:, : self.numbers], found[:, self.numbers].astype(int), found[:, -4:], done.stderr.decode().strip()


@pytest.mark.parametrize(("network", "whole"), [("hybrid+all", False), ("tcn+quantiles", False), ("hybrid", True)])
def test_the_blocks_give_the_bits_of_the_c_code_and_keep_its_rules(
    network, whole, blocks, hard_rows, bundle_of, matlab_folder_of
):
    """S-function under the sanitisers, and the C Caller's function, side by side."""
    program, library = blocks(network, whole)
    bundle = bundle_of(network, whole)
    predictor = bundle.predictor
    made = Folder(make_model("arm", bundle), window=False)
    run = Block(program, predictor, made.described.shapes)
    inputs = random_inputs(predictor, 60, seed=5)
    found, status, counts, error = run(inputs)
    assert error == ""
    wanted = stream(predictor, inputs)
    assert (np.abs(found - wanted) <= tolerance(predictor, inputs, wanted)).all()
    assert status.tolist() == [1] * 8 + [0] * 52
    np.testing.assert_array_equal(counts, np.outer(np.arange(1, 61), [1, 0, 0, 0]))
    function, words = ctypes.CDLL(str(library)).arm_call, made.words
    hard = hard_rows(predictor).astype(np.float32)
    resets = np.zeros(len(hard), dtype=bool)
    resets[75] = True
    found, status, counts, error = run(hard, resets=resets)
    assert error == ""
    state, rows, said = np.zeros(words, np.uint32), np.zeros_like(found), np.zeros(len(hard), np.int32)
    for tick, row in enumerate(hard):
        state, rows[tick], said[tick] = call(function, made.described.shapes, row, resets[tick], 0, state)
    np.testing.assert_array_equal(rows, found)
    np.testing.assert_array_equal(said, status)
    assert (status >= 3).tolist() == np.isnan(found).all(axis=1).tolist()
    assert counts[74].tolist() == [75, 12, 8, 1]
    assert counts[75].tolist() == [1, 0, 0, 0]
    assert status[75] == 1


def call(function, shapes, row, reset, missed, state):
    """One call of the C Caller's function: next state, results one behind the other, status."""
    given, following = np.ascontiguousarray(row, np.float32), np.zeros_like(state)
    results = [np.zeros(rows * columns, np.float32) for rows, columns in shapes.values()]
    status = np.zeros(1, np.int32)
    pointers = [array.ctypes.data_as(ctypes.c_void_p) for array in (given, state, following, *results, status)]
    function(pointers[0], ctypes.c_bool(reset), ctypes.c_uint32(missed), *pointers[1:])
    return following, np.concatenate(results), status[0]


def test_the_s_function_watches_time_and_blocks_are_their_own(blocks, bundle_of):
    program, library = blocks("hybrid")
    bundle = bundle_of("hybrid")
    predictor = bundle.predictor
    made = Folder(make_model("arm", bundle), window=False)
    run, shapes = Block(program, predictor, made.described.shapes), made.described.shapes
    rows, period = random_inputs(predictor, 40, seed=5).astype(float), run.period
    alone, status, _, _ = run(rows)
    for wrong in (2 * period, period / 10, 1e-9):
        assert "must run every 0.01 s, the sample time of the network" in run(rows, period=wrong)[3]
    # Ticks that an enabled subsystem did not run: as the C Caller is told.
    times = np.arange(40) * period
    times[20:] += 3 * period
    times[30:] += 100 * period
    found, status, counts, error = run(rows, times)
    state, function = np.zeros(made.words, np.uint32), ctypes.CDLL(str(library)).arm_call
    for tick, row in enumerate(rows):
        state, numbers, said = call(function, shapes, row, False, {20: 3, 30: 100}.get(tick, 0), state)
        np.testing.assert_array_equal(numbers, found[tick])
        assert said == status[tick]
    assert error == ""
    assert counts[-1].tolist() == [143, 0, 3, 1]
    np.testing.assert_array_equal(found[30:], run(rows[30:])[0])
    # Twice at one time: the same inputs change nothing, others are an algebraic loop.
    twice = np.repeat(np.arange(40) * period, 2)
    np.testing.assert_array_equal(run(np.repeat(rows, 2, axis=0), twice)[0][1::2], alone)
    other = np.repeat(rows, 2, axis=0)
    other[21, 0] += 1
    found, *_, error = run(other, twice)
    assert "algebraic loop" in error
    assert len(found) == 22
    assert "not an integer number of ticks" in run(rows, np.arange(40) * period * 1.5)[3]
    assert "not an integer number of ticks" in run(rows, np.arange(40)[::-1] * period)[3]
    # Minor steps of a continuous solver between ticks are no ticks.
    minor = np.tile([0, 1], 40)
    shifted = twice + minor * period / 2
    np.testing.assert_array_equal(run(np.repeat(rows, 2, axis=0), shifted, minor=minor)[0][0::2], alone)
    # Two blocks in one model.
    pairs = np.stack([rows, rows[::-1]], axis=1).reshape(80, -1)
    found, _, counts, _ = run(pairs, twice, blocks=np.tile([0, 1], 40))
    np.testing.assert_array_equal(found[0::2], alone)
    np.testing.assert_array_equal(found[1::2], run(rows[::-1])[0])


def test_a_state_of_another_network_is_not_taken(blocks, bundle_of):
    bundle = bundle_of("hybrid")
    made = Folder(make_model("arm", bundle), window=False)
    function, row = ctypes.CDLL(str(blocks("hybrid")[1])).arm_call, random_inputs(bundle.predictor, 1, seed=5)[0]
    state, _, _ = call(function, made.described.shapes, row, False, 0, np.zeros(made.words, np.uint32))
    at = np.flatnonzero(state == (int(made.content()["model_hash"][:8], 16) | 1))
    assert len(at) == 1
    state[at] += 2
    for missed in (0, 3):
        _, numbers, status = call(function, made.described.shapes, row, False, missed, state)
        assert status == 4
        assert np.isnan(numbers).all()
    assert call(function, made.described.shapes, row, True, 0, state)[2] == 1  # a reset takes it


@pytest.mark.parametrize("whole", [False, True])
def test_nothing_of_a_block_is_on_the_heap(whole, c, matlab_folder_of, tmp_path):
    c.need("gcc")
    folder = matlab_folder_of("hybrid", whole)
    for file in (*sorted((folder / "core").glob("*.c")), folder / "arm_sfun.c", folder / "arm_call.c"):
        made = tmp_path / f"{file.stem}.o"
        c.run("gcc", *STRICT, "-fno-pie", "-I", folder / "octave", "-I", folder / "core", "-c", file, "-o", made)
        assert not set(c.run("nm", "-u", "-j", made).decode().split()) & HEAP
        kinds = {line.split()[-2] for line in c.run("nm", made).decode().splitlines()}
        assert not kinds & {"B", "b", "D", "d", "C"}  # no numbers that blocks would share


@pytest.mark.parametrize("compiler", ["clang", "x86_64-w64-mingw32-gcc"])
def test_other_compilers_take_the_sources(compiler, matlab_folder_of, tmp_path):
    """Among them the one that MATLAB uses on Windows."""
    if shutil.which(compiler) is None:
        pytest.skip(f"needs {compiler} (make system-packages)")
    folder = matlab_folder_of("hybrid", True)  # it has both runtimes
    sources = [*sorted((folder / "core").glob("*.c")), folder / "arm_sfun.c", folder / "arm_call.c"]
    command = [compiler, *STRICT, "-I", folder / "octave", "-I", folder / "core", "-c", *sources]
    done = subprocess.run([str(part) for part in command], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
