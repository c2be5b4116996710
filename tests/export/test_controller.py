"""Exported controllers: against the ones in Python, tick by tick and in closed loop; faults; heap; hostile text."""

from __future__ import annotations

import ctypes
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from exported_controllers import Compiled, compiled, library_of, sources_of

from edp.control.loop import run_loop
from edp.control.plant import interface_of
from edp.control.plants import plant_of
from edp.control.tasks import draw_task
from edp.errors import BundleError, ConfigError, EdpError, ExportError, StorageError
from edp.export.c.target import CTarget
from edp.export.controller import write_controller
from edp.export.controller.lanes import lane_model
from edp.export.controller.near import near_model
from edp.export.golden import random_inputs
from edp.networks.twin import TWINS
from edp.networks.twin.recurrent import Recurrent
from edp.sim.environment import NominalMachine
from edp.testing.control import sample_excavator_twin
from edp.testing.twins import sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle
from edp.workflows.control.export_controller import export_controller, parts_of
from edp.workflows.control.kept import load_kept

OK, FALLBACK, NEUTRAL, NOT_BEGUN, REFUSED = range(5)
M7 = ("-mthumb", "-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16")
ALLOWED = {
    *("memset", "memcpy", "floorf", "sqrt", "sqrtf", "expf", "logf", "fabsf", "erff", "log1pf"),
    *("exp", "tanh", "sin", "cos", "sincos"),
}
"""What a controller may ask of the C library: none of it allocates."""
HOSTILE = ('x*/ int y; /*"\\', "??/\n#error no", "%n ${name} `id`", "\u202eesrever", "x" * 700)
BOARD = Path(__file__).parent / "board"
STORED = 11_450_000
"""Instructions of a tick on the M7 with GCC 12, -O2: 40 ticks in six blocks on a twin of eight units and a map."""
SAME_LEVER = 2e-3
"""Of a tick from the same memory, a share of full."""
KINDS = ("exported_plan", "exported_grey", "exported_loop")


@pytest.fixture(scope="module")
def kept(exported_plan):
    return load_kept(exported_plan.run)


@pytest.fixture(scope="module")
def env(kept):
    return plant_of("M22", 40.0, 100.0)


def built(kept):
    return kept.experiment.controller.build(kept.plant, kept.experiment.task.limits, kept.models)


@pytest.fixture(scope="module")
def task(kept, env):
    return draw_task(kept.experiment.task, interface_of(env).geometry, 100.0, 3)


@pytest.mark.parametrize("kind", KINDS)
def test_each_tick_is_that_of_the_controller_and_every_rule_holds(c, kind, request, tmp_path):
    exported = request.getfixturevalue(kind)
    program = [*compiled(c, exported.folder, tmp_path), "host_test.c", "-lm", "-o", tmp_path / "program"]
    c.run("gcc", *c.flags, "-I", exported.folder, *program, folder=exported.folder)
    told = c.run(tmp_path / "program").decode()
    assert "all tests passed" in told
    # What was measured on these loops is far below what is allowed.
    assert float(re.search(r"difference of a lever: (\S+)", told)[1]) < SAME_LEVER / 2


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("compiler", "flags"), [("clang", ()), ("arm-none-eabi-gcc", M7), ("gcc", ("-O3",))])
def test_it_compiles_without_a_warning_and_asks_for_no_heap(c, kind, compiler, flags, request, tmp_path):
    c.need(compiler)
    exported = request.getfixturevalue(kind)
    objects = compiled(c, exported.folder, tmp_path, compiler, *flags)
    prefix = "arm-none-eabi-" if compiler.startswith("arm") else ""
    if prefix:
        c.need("arm-none-eabi-gcc")
    asked = set(re.findall(r" U (\w+)", c.run(f"{prefix}nm", *objects).decode()))
    own = set(re.findall(r" [TRDB] (\w+)", c.run(f"{prefix}nm", *objects).decode()))
    outside = {name for name in asked - own if not name.startswith(("__aeabi", "_GLOBAL_OFFSET", "__stack_chk"))}
    assert outside <= ALLOWED
    # No memory that two controllers would share; constants with pointers are data where code may be moved.
    assert not re.findall(r" [bBC] (\w+)", c.run(f"{prefix}nm", *objects).decode())


def test_the_folder_builds_with_its_own_cmake_file(c, exported_plan, tmp_path):
    c.need("cmake", "gcc")
    c.run("cmake", "-S", exported_plan.folder, "-B", tmp_path / "build")
    c.run("cmake", "--build", tmp_path / "build")
    assert b"100% tests passed" in c.run("ctest", "--test-dir", tmp_path / "build")


def test_the_solver_leaves_with_its_licence(exported_plan):
    text = (exported_plan.folder / "daqp" / "LICENSE").read_text()
    assert text.startswith("MIT License")
    assert "Arnstr" in text


def test_loops_on_the_simulator_are_as_good_as_those_of_the_controller_in_python(exported_plan, kept, env):
    python = built(kept)
    ours = Compiled(exported_plan.library, python.plant, python.reads)
    tasks = {seed: draw_task(kept.experiment.task, interface_of(env).geometry, 100.0, seed) for seed in range(1, 5)}
    expected, found = (
        [run_loop(env, controller, task, seed).score for seed, task in tasks.items()] for controller in (python, ours)
    )
    # Single loops part by up to a quarter: rounding decides when a lever leaves a dead band, in Python as well.
    for error in ("position_rms_mm", "path_rms_mm"):
        means = [np.mean([getattr(score, error) for score in scores]) for scores in (expected, found)]
        assert means[1] == pytest.approx(means[0], rel=0.15)
    assert set(ours.statuses) == {OK}
    assert sum(sum(score.violations.values()) for score in found) == 0


def test_a_pi_loop_on_the_simulator_is_that_of_the_controller_in_python(exported_loop):
    kept = load_kept(exported_loop.run)
    env = plant_of("M22", 40.0, 100.0)
    task = draw_task(kept.experiment.task, interface_of(env).geometry, 100.0, 3)
    python = built(kept)
    ours = Compiled(exported_loop.library, python.plant, python.reads)
    expected, found = (run_loop(env, controller, task, 3) for controller in (python, ours))
    levers = [result.recording.select(("Lever_1", "Lever_2", "Lever_3")) for result in (expected, found)]
    # A lever that leaves neutral a tick earlier moves by one slew step.
    apart = np.abs(levers[0] - levers[1]).max(axis=1)
    assert (apart > SAME_LEVER).mean() < 0.02
    assert found.score.position_rms_mm == pytest.approx(expected.score.position_rms_mm, abs=0.3)


def test_whatever_comes_levers_stay_within_range_and_slew(exported_plan, kept, task):
    python = built(kept)
    ours = Compiled(exported_plan.library, python.plant, python.reads)
    assert ours.reset(kept.observed[0], task.reference) == OK
    rng, before = np.random.default_rng(0), np.zeros(3)
    for tick in range(400):
        row = kept.observed[min(tick, len(kept.observed) - 1)].copy()
        kind = rng.integers(0, 6)
        if kind < 3:
            row[rng.integers(0, len(row))] = (np.nan, np.inf, 3e38)[kind]
        elif kind == 3:
            row *= rng.normal(1.0, 5.0, len(row))
        if rng.random() < 0.05:
            ours.missed(ours.state, ctypes.c_uint32(int(rng.integers(0, 20))))
        levers = ours.step(row, tick)
        assert np.isfinite(levers).all()
        assert np.abs(levers).max() <= 1.0
        assert np.abs(levers - before).max() <= 0.05 + 1e-6
        before = levers
    assert {OK, NEUTRAL} <= set(ours.statuses)
    for tick in range(40):
        assert ours.step(np.full(len(row), np.nan), tick) == pytest.approx(
            np.maximum(np.abs(before) - 0.05, 0) * np.sign(before), abs=1e-5
        )
        before = np.maximum(np.abs(before) - 0.05, 0) * np.sign(before)
    assert before == pytest.approx(0.0)
    # Once sensors are back, the plan is.
    assert [ours.step(kept.observed[0], 0) is not None and ours.statuses[-1] for _ in range(3)] == [OK] * 3


def test_a_loop_on_a_grey_box_in_c_is_as_good_as_that_in_python(exported_grey):
    kept = load_kept(exported_grey.run)
    env = plant_of("M22", 40.0, 100.0)
    task = draw_task(kept.experiment.task, interface_of(env).geometry, 100.0, 3)
    python = built(kept)
    ours = Compiled(exported_grey.library, python.plant, python.reads)
    expected, found = (run_loop(env, controller, task, 3) for controller in (python, ours))
    assert found.score.position_rms_mm == pytest.approx(expected.score.position_rms_mm, rel=0.15, abs=0.5)
    assert found.score.path_rms_mm == pytest.approx(expected.score.path_rms_mm, rel=0.15, abs=0.5)
    assert set(ours.statuses) == {OK}


def test_equations_that_take_too_long_bring_the_pi_loop_in_time(c, exported_grey, tmp_path):
    export_controller(exported_grey.run, tmp_path / "c", "machine", {"newton": "2"})
    assert "#define MACHINE_CONTROL_NEWTON 2u" in (tmp_path / "c" / "machine_control.h").read_text()
    kept = load_kept(exported_grey.run)
    python = built(kept)
    ours = Compiled(library_of(c, tmp_path / "c", tmp_path / "objects"), python.plant, python.reads)
    assert ours.reset(kept.observed[0], reference_of(kept)) == OK
    for tick in range(5):
        levers = ours.step(kept.observed[tick], tick)
        assert np.abs(levers).max() <= 1.0
    assert set(ours.statuses) == {FALLBACK}


def test_an_input_that_is_missing_leaves_the_model_running_as_in_python(exported_plan, kept):
    python = built(kept)
    ours = Compiled(exported_plan.library, python.plant, python.reads)
    reference = reference_of(kept)
    python.reset(kept.observed[0], reference)
    assert ours.reset(kept.observed[0], reference) == OK
    for tick in range(12):
        row = kept.observed[tick].copy()
        row[kept.plant.columns(("CylVels_1",))] = np.nan if tick in (5, 6, 7) else 0.0
        expected, found = python.step(row, tick), ours.step(row, tick)
        assert ours.statuses[-1] == (NEUTRAL if tick in (5, 6, 7) else OK)
        # Without sensors levers depend on the memory alone; else rounding decides when one leaves a dead band.
        assert found == pytest.approx(expected, abs=0.05)


def reference_of(kept):
    from edp.control.reference import TipReference

    return TipReference(kept.plant.rate_hz, kept.strokes, kept.tip, np.ones(len(kept.strokes), bool))


@pytest.mark.parametrize("what", ["strokes", "tip", "finite", "inputs", "empty"])
def test_a_reference_that_cannot_be_followed_is_refused_before_the_start(what, exported_plan, kept):
    python, reference = built(kept), reference_of(kept)
    ours = Compiled(exported_plan.library, python.plant, python.reads)
    strokes, tip, row = reference.strokes.copy(), reference.tip.copy(), kept.observed[0].copy()
    if what == "strokes":
        strokes[7, 1] = kept.plant.geometry.full_m[1] + 0.02
    elif what == "tip":
        tip[9, 0] += 0.5
    elif what == "finite":
        tip[3, 2] = np.nan
    elif what == "inputs":
        row[:] = np.nan
    else:
        strokes, tip = strokes[:0], tip[:0]
    assert ours.reset(row, replace(reference, strokes=strokes, tip=tip)) == REFUSED
    assert ours.step(kept.observed[0], 0) == pytest.approx(0.0)
    assert ours.statuses == [NOT_BEGUN]


def sanitised_stream(c, exported, tmp_path, rows):
    """Rows through the host test under the sanitisers: levers and status, shape (tick, 4)."""
    flags = ("-std=c99", "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    sources = [*sources_of(exported.folder), "host_test.c", "-lm", "-o", tmp_path / "program"]
    c.run("gcc", *flags, *sources, folder=exported.folder)
    told = c.run(tmp_path / "program", "stream", feed=np.ascontiguousarray(rows, np.float32).tobytes())
    return np.frombuffer(told, np.float32).reshape(len(rows), 4)


@pytest.mark.parametrize("kind", KINDS)
def test_any_bits_of_inputs_break_no_rule_of_c(c, kind, request, tmp_path):
    exported = request.getfixturevalue(kind)
    kept = load_kept(exported.run)
    reads = built(kept).reads
    rng = np.random.default_rng(1)
    rows = np.repeat(kept.observed[:1, kept.plant.columns(reads)], 120, axis=0).astype(np.float32)
    wild = rng.integers(0, 2**32, rows.shape, dtype=np.uint32).view(np.float32)
    rows = np.where(rng.random((120, 1)) < 0.3, np.where(rng.random(rows.shape) < 0.3, wild, rows), rows)
    found = sanitised_stream(c, exported, tmp_path, rows)
    assert np.isfinite(found).all()
    assert (np.abs(found[:, :3]) <= 1.0).all()
    assert set(found[:, 3]) <= {OK, NEUTRAL, FALLBACK}


@pytest.mark.parametrize("name", ["recurrent", "static", "arx"])
def test_lanes_have_the_numbers_of_the_exported_network(c, name, tmp_path):
    c.need("gcc")
    spec = Recurrent(units=37, members=1) if name == "recurrent" else TWINS[name]()
    bundle = plant_bundle(TwinBundle(spec, sample_twin(spec)[0]))
    model, plant = lane_model("lanes", bundle), bundle.predictor
    CTarget().write(bundle, "predictor", tmp_path)
    for file, text in model.files().items():
        (tmp_path / file).write_text(text)
    lanes = 7
    (tmp_path / "both.c").write_text(
        BOTH.replace("MANY", f"{lanes}u").replace("NEAR", "1e-4f" if name == "recurrent" else "0.0f")
    )
    sources = ["both.c", "predictor.c", *model.sources]
    c.run("gcc", *c.flags, "-O2", *sources, "-lm", "-o", "both", folder=tmp_path)
    rows = np.stack([random_inputs(plant, 60, seed) for seed in range(lanes)], axis=1)
    c.run(tmp_path / "both", feed=rows.tobytes())


BOTH = """
#include "predictor.h"
#include "lanes.h"
#include <math.h>
#include <stdio.h>
#define LAST_PORTS (LANES_INPUTS - LANES_ANSWERS)
static predictor_state states[MANY];
static lanes_memory memories[MANY];
static float works[MANY][LANES_WORK];
static float answers[MANY][LANES_ANSWERS];
static float rows[MANY][LANES_INPUTS];
int main(void) {
    for (uint32_t k = 0; k < MANY; k++) {
        predictor_reset(&states[k]);
        lanes_forget(&memories[k]);
    }
    while (fread(rows, sizeof rows, 1u, stdin) == 1u) {
        bool measured = false;
        for (uint32_t i = LAST_PORTS; i < LANES_INPUTS; i++) {
            for (uint32_t k = 0; k < MANY; k++) {
                measured = measured || (rows[k][i] > 0.0f);
            }
        }
        if (!(measured ? lanes_step : lanes_run)(memories, (const float(*)[LANES_INPUTS])rows, works, answers, MANY)) {
            return 2;
        }
        for (uint32_t k = 0; k < MANY; k++) {
            predictor_output out;
            (void)predictor_step(&states[k], rows[k], &out);
            for (uint32_t i = 0; i < LANES_ANSWERS; i++) {
                const float exact = out.prediction[0][i];
                /* Gates are those of another function in the last places; without gates the bits are the same. */
                if ((fabsf(answers[k][i] - exact) > NEAR * (1.0f + fabsf(exact)))) {
                    return 3;
                }
            }
        }
    }
    return lanes_check() ? 0 : 4;
}
"""


def test_pilot_pressures_are_those_of_the_machine(c, exported_plan, kept, tmp_path):
    (tmp_path / "pilots.c").write_text(PILOTS)
    folder = exported_plan.folder
    program = ("-o", tmp_path / "pilots", "-I", folder)
    rest = (folder / "edp_control.c", folder / "edp_runtime.c", "-lm")
    c.run("gcc", "-std=c99", tmp_path / "pilots.c", *rest, *program)
    levers = np.random.default_rng(0).uniform(-1, 1, (200, 3)).astype(np.float32)
    levers[:3] = [[0, 0, 0], [1, 1, 1], [-1, -1, -1]]
    told = c.run(tmp_path / "pilots", feed=levers.tobytes())
    found = np.frombuffer(told, np.float32).reshape(200, -1)
    nominal = NominalMachine(kept.plant.geometry.machine).commands(levers)
    order = [channel.name for channel in kept.twin.twin.channels.commands]
    names = [channel.name for channel in kept.plant.command_channels]
    assert found == pytest.approx(nominal[:, [names.index(name) for name in order]], abs=2.0)


PILOTS = """
#include "machine_control.h"
#include "machine_control_numbers.h"
#include <stdio.h>
int main(void) {
    float levers[3];
    while (fread(levers, sizeof levers, 1u, stdin) == 1u) {
        for (uint32_t i = 0; i < sizeof pilots / sizeof pilots[0]; i++) {
            const float p = edp_pilot_pressure(&lever_shape, &pilots[i], levers);
            (void)fwrite(&p, sizeof p, 1u, stdout);
        }
    }
    return 0;
}
"""


def test_text_of_channels_machine_and_twin_stays_text(c, kept, tmp_path):
    parts = parts_of(kept.experiment, kept.plant, kept.models, kept.twin)
    inputs = tuple(
        replace(channel, name=HOSTILE[i % 5], description=HOSTILE[(i + 1) % 5])
        for i, channel in enumerate(parts.inputs)
    )
    plant = parts.plan.plant
    names = tuple(replace(channel, name=HOSTILE[i % 5] + str(i)) for i, channel in enumerate(plant.inputs))
    plant.predictor._title = HOSTILE[0]
    hostile = replace(
        parts,
        inputs=inputs,
        machine=HOSTILE[0],
        title=HOSTILE[1],
        plan=replace(parts.plan, plant=replace(plant, inputs=names)),
    )
    write_controller(hostile, "machine", tmp_path / "c")
    for path in (tmp_path / "c").glob("*.[ch]"):
        assert path.read_text().replace("\n", "").isprintable(), path
        assert max(map(len, path.read_text().splitlines())) < 4095
    library = library_of(c, tmp_path / "c", tmp_path / "objects")
    subprocess.run([sys.executable, "-c", "import ctypes, sys; ctypes.CDLL(sys.argv[1])", str(library)], check=True)
    header = (tmp_path / "c" / "machine_control.h").read_text()
    found = re.findall(r"^    (MACHINE_CONTROL_IN_\w+) = \d+,", header, re.MULTILINE)
    assert len(set(found)) == len(inputs)
    assert "int y" not in re.sub(r"/\*.*?\*/", "", header, flags=re.S)


@pytest.mark.parametrize("name", ["", "Upper", "2nd", "with space", "../up", "class", "a" * 21, "edp_x"])
def test_names_that_c_cannot_carry_are_refused(name, exported_plan, tmp_path):
    with pytest.raises(ExportError, match="name"):
        export_controller(exported_plan.run, tmp_path / "c", name)
    assert not (tmp_path / "c").exists()


@pytest.mark.parametrize(
    ("options", "text"),
    [({"tangent": "true"}, "no such option"), ({"iterations": "1"}, "from 2 to"), ({"newton": "-5"}, "from 2 to")],
)
def test_options_that_cannot_be_are_refused(options, text, exported_plan, tmp_path):
    with pytest.raises(ConfigError, match=text):
        export_controller(exported_plan.run, tmp_path / "c", "machine", options)


def test_a_run_that_kept_no_controller_is_refused(tmp_path):
    with pytest.raises(StorageError, match=r"one of an earlier version: it has no controller\.json"):
        export_controller(tmp_path, tmp_path / "c", "machine")


def test_a_network_on_a_grey_box_is_refused(kept):
    spec = TWINS["residual"]()
    parts = parts_of(kept.experiment, kept.plant, kept.models, kept.twin)
    residual = plant_bundle(TwinBundle(spec, sample_twin(spec)[0]))
    assert near_model("machine_plant", replace(parts.plan, plant=residual)) is None
    with pytest.raises(ExportError, match="network on a grey box"):
        lane_model("machine_plant", residual)
    assert parts.plan.lane_ticks == 40 + 3 * (40 + 38 + 35 + 31 + 25 + 15) + 1 + 20


def test_an_inversion_has_no_form_in_c(kept):
    from edp.control.controllers.inversion import ModelInversion

    with pytest.raises(ExportError, match="'inversion' has no form in C"):
        parts_of(replace(kept.experiment, controller=ModelInversion()), kept.plant, kept.models, kept.twin)


def test_a_static_map_can_be_the_model(c, kept, tmp_path):
    twin = sample_excavator_twin()
    bundle = TwinBundle(TWINS["static"](), twin)
    models = replace(kept.models, twin=twin)
    write_controller(parts_of(kept.experiment, kept.plant, models, bundle), "machine", tmp_path / "c")
    assert not (tmp_path / "c" / "host_test.c").exists()
    library_of(c, tmp_path / "c", tmp_path / "objects")


@pytest.mark.parametrize("damage", ["header", "arrays", "machine", "channels"])
def test_a_run_that_was_damaged_is_refused(damage, exported_loop, tmp_path):
    import shutil

    run = tmp_path / "run"
    shutil.copytree(exported_loop.run, run)
    folder = run / "controller"
    if damage == "header":
        (folder / "controller.json").write_text((folder / "controller.json").read_text().replace("100.0", "50.0"))
    elif damage == "arrays":
        file = next(folder.glob("arrays-*"))
        file.write_bytes(file.read_bytes()[:-8])
    elif damage == "machine":
        (folder / "machine.toml").write_text("name = 3")
    else:
        (folder / "controller.json").write_text("{}")
    with pytest.raises(EdpError) as error:
        export_controller(run, tmp_path / "c", "machine")
    assert isinstance(error.value, BundleError | ConfigError | StorageError)
    assert not (tmp_path / "c").exists()


def test_what_is_kept_is_what_was_run(kept, exported_plan):
    again = built(kept)
    again.reset(kept.observed[0], reference_of(kept))
    levers = np.array([again.step(kept.observed[tick], tick) for tick in range(40)])
    assert levers == pytest.approx(kept.levers[:40], abs=1e-6)
    assert (exported_plan.folder / "export.sha256").is_file()


def test_two_exports_are_the_same_bytes(exported_plan, tmp_path):
    export_controller(exported_plan.run, tmp_path / "c", "machine")
    for file in exported_plan.files:
        again = tmp_path / "c" / file.relative_to(exported_plan.folder)
        assert again.read_bytes() == file.read_bytes()


def test_a_cortex_m7_gives_the_bits_of_this_machine(c, exported_plan, tmp_path):
    c.need("gcc", "arm-none-eabi-gcc", "qemu-system-arm")
    folder, sources = exported_plan.folder, sources_of(exported_plan.folder)
    flags = ("-std=gnu99", "-O2", "-ffp-contract=off", "-I", folder)
    c.run("gcc", *flags, *sources, BOARD / "control.c", "-lm", "-o", tmp_path / "here", folder=folder)
    here = c.run(tmp_path / "here").decode().splitlines()
    board = (*M7, "--specs=rdimon.specs", "-nostartfiles", "-DCLOCK_HZ=25000000u", "-T", BOARD / "mps2.ld")
    rest = (BOARD / "control.c", BOARD / "startup.c", "-lm", "-lrdimon", "-o", tmp_path / "image.elf")
    c.run("arm-none-eabi-gcc", *flags, *board, *sources, *rest, folder=folder)
    emulator = ("qemu-system-arm", "-M", "mps2-an500", "-nographic", "-icount", "shift=0")
    emulated = c.run(*emulator, "-semihosting-config", "enable=on,target=native", "-kernel", tmp_path / "image.elf")
    count, levers = emulated.decode().splitlines()
    assert levers == here[1]
    assert 0.8 * STORED < int(count.split()[0]) < 1.05 * STORED
