"""Exported monitors: the chain bit by bit, residuals within tolerance, missing inputs, heap, hostile text, FMU."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from edp.config.monitor import load_monitor_experiment
from edp.data.features import FeatureSet
from edp.data.scaling import fit_scaler
from edp.data.task import TargetMode, Task
from edp.errors import BundleError, ConfigError, ExportError
from edp.evaluation.controller import STACK_BYTES, Budget
from edp.evaluation.monitor_footprint import monitor_footprint
from edp.export.monitor import monitor_files, write_monitor
from edp.export.monitor.golden import drawn_rows
from edp.monitor.detectors import EDetectorSpec
from edp.monitor.monitor_file import save_monitor
from edp.monitor.residuals.virtual_sensors import VirtualSensors
from edp.networks.backbones import GruSpec
from edp.networks.outputs import OUTPUTS
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.twin import TWINS
from edp.signals import Kind
from edp.testing.twins import RATE_HZ, sample_actuators, sample_twin
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle
from edp.workflows.monitor import fit_to_recordings
from edp.workflows.monitor.export_monitor import export_monitor, monitor_parts

OK, WARMING, HELD, RESTARTED, NOT_RESET = range(5)
M4 = ("-mthumb", "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
ALLOWED = {"memset", "memcpy", "floorf", "sqrtf", "erff", "log1pf", "expf", "logf"}
"""What the rig's monitor may ask of the C library: none of it allocates, and the chain asks for the first two only."""
HOSTILE = ('x*/ int y; /*"\\', "??/\n#error no", "%n ${name} `id`", "\u202eesrever", "x" * 700)


@pytest.fixture(scope="module")
def folder(c, rig_monitor, tmp_path_factory):
    """The exported monitor."""
    path = tmp_path_factory.mktemp("monitor")
    save_monitor(rig_monitor, path / "fitted")
    export_monitor(path / "fitted", "c", path / "c", "watch")
    return path / "c"


def sources(folder):
    return sorted(path.name for path in folder.glob("*.c") if path.name not in ("host_test.c", "example_task.c"))


@pytest.fixture(scope="module")
def program(c, folder, tmp_path_factory):
    """Its self-test under the sanitisers."""
    c.need("gcc")
    path = tmp_path_factory.mktemp("program") / "program"
    flags = ("-O1", "-g", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
    c.run("gcc", *c.flags, *flags, *sources(folder), "host_test.c", "-lm", "-o", path, folder=folder)
    return path


def chain_rows(c, program, inputs, residuals, monitor):
    """Block, since, watch of an alarm or -1, statistics, evidence: a row a block that C judged."""
    rows = np.concatenate([inputs, residuals], axis=1).astype(np.float32)
    width = 3 + len(monitor.chain.watches) + monitor.chain.summaries.width
    return np.frombuffer(c.run(program, "chain", feed=rows.tobytes()), np.float64).reshape(-1, width)


def python_rows(verdicts, monitor):
    evidence, rows = np.zeros(monitor.chain.summaries.width), []
    for verdict in verdicts:
        alarm = -1 if verdict.alarm is None else verdict.alarm
        evidence = verdict.evidence if verdict.alarm is not None else evidence
        rows.append(np.concatenate([[verdict.block, verdict.since, alarm], verdict.statistics, evidence]))
    return np.array(rows)


def test_the_self_test_passes_under_the_sanitisers(c, program):
    told = c.run(program).decode()
    assert "all tests passed" in told
    # The drawn rows are shifted in their second half, so alarms are compared and not only silence.
    assert int(re.search(r"blocks, (\d+) alarms", told)[1]) > 0
    assert float(re.search(r"share of what is allowed: (\S+)", told)[1]) < 0.5


@pytest.mark.parametrize(("compiler", "level"), [("gcc", "-O3"), ("clang", "-O2"), ("clang", "-O0")])
def test_every_compiler_gives_the_bits_of_python(c, compiler, level, folder, tmp_path):
    c.need(compiler)
    c.run(compiler, *c.flags, level, *sources(folder), "host_test.c", "-lm", "-o", tmp_path / "p", folder=folder)
    assert "all tests passed" in c.run(tmp_path / "p").decode()


def test_a_recording_with_a_fault_gives_the_bits_of_python(c, program, rig_monitor, rig_fault):
    residuals, _ = rig_monitor.residuals(rig_fault, rig_monitor.initial_state())
    verdicts, _ = rig_monitor.chain.run(residuals, rig_fault, rig_monitor.chain.initial_state())
    expected = python_rows(verdicts, rig_monitor)
    assert (expected[:, 2] >= 0).any()
    found = chain_rows(c, program, rig_fault, residuals, rig_monitor)
    # The last verdict comes while the next block is formed, and there is none behind the last.
    np.testing.assert_array_equal(found, expected[: len(found)])
    assert len(found) >= len(expected) - 1


def test_any_residuals_and_inputs_give_the_bits_of_python(c, program, rig_monitor):
    rng = np.random.default_rng(5)
    inputs, residuals = drawn_rows(rig_monitor.chain)
    inputs, residuals = inputs.copy(), residuals.copy()
    for rows in (inputs, residuals):
        rows *= np.exp(rng.normal(0.0, 1.5, (len(rows), 1))).astype(np.float32)
        rows[rng.random(rows.shape) < 0.2] = np.nan
        rows[rng.random(rows.shape) < 0.001] = np.float32(1e37)
    rows[100:400, 0] = np.nan  # whole blocks without a residual
    verdicts, _ = rig_monitor.chain.run(residuals, inputs, rig_monitor.chain.initial_state())
    found = chain_rows(c, program, inputs, residuals, rig_monitor)
    np.testing.assert_array_equal(found, python_rows(verdicts, rig_monitor)[: len(found)])


def streamed(c, program, rows, monitor):
    """Residuals, outputs (alarm, alarms, since, silent, statistics) and status of each tick."""
    width = len(monitor.residual_names) + 4 + len(monitor.chain.watches) + 1
    found = c.run(program, "stream", feed=np.ascontiguousarray(rows, np.float32).tobytes())
    return np.split(np.frombuffer(found, np.float32).reshape(len(rows), width), [len(monitor.residual_names), -1], 1)


def test_a_whole_stream_finds_what_python_finds(c, program, rig_monitor, rig_fault):
    parts = monitor_parts(rig_monitor)
    residuals, out, status = streamed(c, program, rig_fault, rig_monitor)
    expected, _ = rig_monitor.residuals(rig_fault, rig_monitor.initial_state())
    assert (np.abs(residuals - expected) <= parts.golden_residuals.tolerance).all()
    verdicts, _ = rig_monitor.advance(rig_fault, rig_monitor.initial_state())
    alarms = [verdict.block for verdict in verdicts if verdict.alarm is not None]
    assert alarms
    block = rig_monitor.chain.summaries.block
    raised = np.flatnonzero(np.diff(out[:, 1]) > 0) // block
    # A verdict is told during the block behind its own.
    assert raised[0] == alarms[0]
    assert out[-1, 1] == pytest.approx(len(alarms), abs=1)
    assert set(status[:, 0]) == {WARMING, OK}


def test_missing_inputs_silence_their_residuals_and_no_others(c, program, rig_monitor, rig_fault):
    rows = rig_fault[:400].copy()
    rows[150:160, 2] = np.nan
    rows[200:203, 3] = (np.inf, -np.inf, 3e30)
    rows[250] = np.nan
    residuals, out, status = streamed(c, program, rows, rig_monitor)
    expected, _ = rig_monitor.residuals(rig_monitor.plausible(rows), rig_monitor.initial_state())
    np.testing.assert_array_equal(np.isnan(residuals), np.isnan(expected))
    there = ~np.isnan(expected)
    assert (np.abs(residuals - expected) <= monitor_parts(rig_monitor).golden_residuals.tolerance)[there].all()
    np.testing.assert_array_equal(out[:, 3], np.isnan(expected).sum(axis=1))
    held = np.zeros(400, bool)
    held[[*range(150, 160), 200, 201, 202, 250]] = True
    np.testing.assert_array_equal(status[:, 0] == HELD, held)


def test_any_bits_of_inputs_break_no_rule_of_c(c, program, rig_monitor, rig_fault):
    rng = np.random.default_rng(1)
    wild = rng.integers(0, 2**32, rig_fault.shape, dtype=np.uint32).view(np.float32)
    rows = np.where(rng.random(rig_fault.shape) < 0.2, wild, rig_fault)
    _, out, status = streamed(c, program, rows, rig_monitor)
    assert np.isfinite(out).all()
    assert set(status[:, 0]) <= {OK, WARMING, HELD}


@pytest.mark.parametrize(("compiler", "flags"), [("clang", ()), ("arm-none-eabi-gcc", M4)])
def test_it_asks_for_no_heap_and_shares_no_memory(c, compiler, flags, folder, tmp_path):
    c.need(compiler)
    prefix = "arm-none-eabi-" if compiler.startswith("arm") else ""
    objects = []
    for source in [*sources(folder), "example_task.c"]:
        objects.append(tmp_path / f"{source}.o")
        c.run(compiler, *c.flags, "-O2", *flags, "-c", source, "-o", objects[-1], folder=folder)
    listed = c.run(f"{prefix}nm", *objects[:-1]).decode()
    asked, own = set(re.findall(r" U (\w+)", listed)), set(re.findall(r" [TRDB] (\w+)", listed))
    outside = {n for n in asked - own if not n.startswith(("__aeabi", "_GLOBAL_OFFSET", "__stack_chk", "platform_"))}
    assert outside <= ALLOWED
    assert not re.findall(r" [bBC] (\w+)", listed)
    chain = c.run(f"{prefix}nm", tmp_path / "edp_chain.c.o").decode()
    assert {n for n in re.findall(r" U (\w+)", chain) if not n.startswith(("__aeabi", "_GLOBAL"))} <= {
        "memset",
        "memcpy",
    }


def test_the_root_is_that_of_ieee_754(c, folder, tmp_path):
    c.need("gcc")
    (tmp_path / "root.c").write_text(ROOT)
    c.run("gcc", *c.flags, "-I", folder, tmp_path / "root.c", folder / "edp_chain.c", "-o", tmp_path / "root")
    rng = np.random.default_rng(0)
    any_bits = rng.integers(0, 2**63, 100_000, dtype=np.uint64).view(np.float64)
    special = [0.0, -0.0, 5e-324, 2.2250738585072014e-308, 1e308, np.inf, *np.arange(200.0) ** 2]
    x = np.concatenate([any_bits[~np.isnan(any_bits)], rng.random(1000) * 1e-310, special])
    found = np.frombuffer(c.run(tmp_path / "root", feed=x.tobytes()), np.float64)
    np.testing.assert_array_equal(found.view(np.uint64), np.sqrt(x).view(np.uint64))
    negative = np.frombuffer(c.run(tmp_path / "root", feed=np.array([-1.0, np.nan]).tobytes()), np.float64)
    assert np.isnan(negative).all()


ROOT = """
#include "edp_chain.h"
#include <stdio.h>
int main(void) {
    double x;
    while (fread(&x, sizeof x, 1u, stdin) == 1u) {
        x = edp_root(x);
        (void)fwrite(&x, sizeof x, 1u, stdout);
    }
    return 0;
}
"""


def test_the_folder_builds_with_its_own_cmake_file(c, folder, tmp_path):
    c.need("cmake", "gcc")
    c.run("cmake", "-S", folder, "-B", tmp_path / "build")
    c.run("cmake", "--build", tmp_path / "build")
    assert b"100% tests passed" in c.run("ctest", "--test-dir", tmp_path / "build")


def test_text_of_channels_and_residuals_stays_text(c, rig_monitor, tmp_path):
    c.need("gcc")
    parts = monitor_parts(rig_monitor)
    inputs = tuple(
        replace(channel, name=f"{HOSTILE[i % 5]}{i}", description=HOSTILE[(i + 1) % 5])
        for i, channel in enumerate(parts.inputs)
    )
    names = tuple(f"{HOSTILE[i % 5]}{i}" for i in range(len(parts.residuals)))
    hostile = replace(parts, inputs=inputs, residuals=names, title=HOSTILE[0], promise=HOSTILE[1])
    write_monitor(hostile, "watch", tmp_path)
    for path in tmp_path.glob("*.[ch]"):
        assert path.read_text().replace("\n", "").isprintable(), path
        assert max(map(len, path.read_text().splitlines())) < 4095
    c.run("gcc", *c.flags, "-shared", "-fPIC", *sources(tmp_path), "-lm", "-o", "w.so", folder=tmp_path)
    command = [sys.executable, "-c", "import ctypes, sys; ctypes.CDLL(sys.argv[1])", str(tmp_path / "w.so")]
    subprocess.run(command, check=True)
    header = re.sub(r"/\*.*?\*/", "", (tmp_path / "watch.h").read_text(), flags=re.S)
    assert len(set(re.findall(r"^    (WATCH_IN_\w+) = \d+,", header, re.MULTILINE))) == len(inputs)
    assert len(set(re.findall(r"^    (WATCH_RES_\w+) = \d+,", header, re.MULTILINE))) == len(names)
    assert "int y" not in header


def test_damaged_constants_are_seen(c, folder, tmp_path):
    c.need("gcc")
    text = (folder / "watch_numbers.h").read_text()
    number = re.search(r"static const double centre\[\d+\] = \{\n    (\S+),", text)[1]
    (tmp_path / "watch_numbers.h").write_text(text.replace(f"    {number},", "    12345.0,", 1))
    (tmp_path / "check.c").write_text('#include "watch.h"\nint main(void) { return watch_check() ? 0 : 1; }\n')
    (tmp_path / "watch.c").write_text((folder / "watch.c").read_text())
    rest = [folder / name for name in sources(folder) if name != "watch.c"]
    flags = ("-std=c99", "-I", tmp_path, "-I", folder)
    c.run("gcc", *flags, tmp_path / "check.c", tmp_path / "watch.c", *rest, "-lm", "-o", tmp_path / "check")
    assert subprocess.run([str(tmp_path / "check")]).returncode == 1


@pytest.mark.parametrize("name", ["", "Upper", "2nd", "../up", "class", "a" * 21, "edp_x"])
def test_names_that_c_cannot_carry_are_refused(name, rig_monitor):
    with pytest.raises(ExportError, match="name"):
        monitor_files(monitor_parts(rig_monitor), name)


def test_what_has_no_form_in_c_is_refused(rig_monitor, tmp_path):
    watch = replace(rig_monitor.chain.watches[0], detector=EDetectorSpec())
    other = replace(rig_monitor, chain=replace(rig_monitor.chain, watches=(watch,)))
    with pytest.raises(
        ExportError, match=r"'e_detector' has no form in C; these have: cusum, ewma, glr, separate_cusums"
    ):
        monitor_parts(other)
    coarse = replace(rig_monitor.chain.watches[0], mean=rig_monitor.chain.watches[0].mean + 1e-12)
    fine = replace(rig_monitor, chain=replace(rig_monitor.chain, watches=(coarse,)))
    with pytest.raises(ExportError, match="no float32 numbers; fit it again"):
        write_monitor(monitor_parts(fine), "watch", tmp_path / "c")
    save_monitor(rig_monitor, tmp_path / "fitted")
    with pytest.raises(ExportError, match="no form 'onnx'"):
        export_monitor(tmp_path / "fitted", "onnx", tmp_path / "c", "watch")
    with pytest.raises(ConfigError, match="no such option"):
        export_monitor(tmp_path / "fitted", "c", tmp_path / "c", "watch", {"tangent": "true"})
    with pytest.raises(BundleError, match="not a monitor"):
        export_monitor(tmp_path, "c", tmp_path / "c", "watch")
    assert not (tmp_path / "c").exists()


@pytest.fixture(scope="module")
def ahead_monitor():
    """A monitor with look-ahead networks, with and without intervals, and a twin with free ports; none is trained."""
    sessions = [sample_actuators(900, seed) for seed in range(10)]
    task = Task(
        FeatureSet("all", sessions[0].channel_names), ("speed_1", "pressure_1"), (1, 3), TargetMode.DELTA, RATE_HZ
    )
    scaler = fit_scaler(task, [task.series(s) for s in sessions], [channel.kind for channel in sessions[0].channels])
    bundles = []
    for output in (OUTPUTS["point"](), OUTPUTS["quantiles"]()):
        spec = ModelSpec(backbone=GruSpec(units=6), window=8, output=output)
        predictor = build_model(task, spec, scaler, seed=2)
        kinds = (Kind.VELOCITY, Kind.PRESSURE)
        bundles.append(Bundle(predictor, sessions[0].channels, kinds, ("speed", "pressure")))
    spec = TWINS["recurrent"](units=6, members=1)
    twin = TwinBundle(spec, sample_twin(spec)[0])
    changes = [
        *("chain.block_s=0.4", "chain.settle_s=1.0", "chain.folds=2", "train_fraction=0.3"),
        'chain.watches=[{detector={kind="cusum",slack=0.5},memory_s=0.4}]',
        'residuals=[{kind="look_ahead"},{kind="twin_ports",free_s=0.3}]',
    ]
    experiment = load_monitor_experiment(None, changes, {"hours_per_false_alarm": 0.01, "minutes": 0.02})
    return fit_to_recordings(sessions, experiment, [*bundles, twin]).monitor, sessions[0]


def test_look_ahead_networks_and_twins_with_free_ports(c, ahead_monitor, tmp_path):
    monitor, session = ahead_monitor
    assert {name.split(":")[0] for name in monitor.residual_names} == {"ahead", "ahead1", "twin"}
    parts = monitor_parts(monitor)
    write_monitor(parts, "watch", tmp_path)
    flags = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    c.run("gcc", *c.flags, *flags, *sources(tmp_path), "host_test.c", "-lm", "-o", "program", folder=tmp_path)
    assert "all tests passed" in c.run(tmp_path / "program").decode()
    rows = session.select(monitor.inputs).copy()
    rows[300:310, 1] = np.nan
    residuals, _, _ = streamed(c, tmp_path / "program", rows, monitor)
    expected, _ = monitor.residuals(rows, monitor.initial_state())
    np.testing.assert_array_equal(np.isnan(residuals), np.isnan(expected))
    # Predictions of the first ticks are about ticks that come later.
    assert np.isnan(expected[0]).any()
    scale = np.nanstd(expected, axis=0)
    assert (np.nan_to_num(np.abs(residuals - expected)) < 1e-3 * scale).all()


@pytest.fixture(scope="module")
def turns_monitor(rig_monitor):
    """Virtual sensors by turns, as if they had been trained so: what they say does not matter here."""
    source = rig_monitor.sources[0]
    assert len(source.bundles) > 3
    turns = VirtualSensors(source.bundles, source.inputs, source.middle, every=3)
    return replace(rig_monitor, sources=(turns, *rig_monitor.sources[1:]))


def test_networks_that_take_turns(c, turns_monitor, rig_fault, tmp_path):
    c.need("gcc")
    write_monitor(monitor_parts(turns_monitor), "watch", tmp_path)
    flags = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    c.run("gcc", *c.flags, *flags, *sources(tmp_path), "host_test.c", "-lm", "-o", "program", folder=tmp_path)
    assert "all tests passed" in c.run(tmp_path / "program").decode()
    rows = rig_fault[900:1300].copy()
    rows[150:160, 2] = np.nan
    rows[250] = np.nan
    rows[301, 3] = np.nan
    residuals, _, _ = streamed(c, tmp_path / "program", rows, turns_monitor)
    expected, _ = turns_monitor.residuals(rows, turns_monitor.initial_state())
    np.testing.assert_array_equal(np.isnan(residuals), np.isnan(expected))
    held = np.nan_to_num(np.abs(residuals - expected))
    assert (held <= monitor_parts(turns_monitor).golden_residuals.tolerance).all()
    own = turns_monitor.sources[0].bundles.values()
    of_second = len(next(iter(own)).task.targets)
    # The second network runs at ticks 1, 4, 7 and so on.
    changes = np.flatnonzero(np.diff(residuals[:100, of_second]) != 0.0)
    assert np.isnan(residuals[0, of_second])
    assert {int(tick) % 3 for tick in changes[1:]} == {0}


def test_the_footprint_counts_turns(rig_monitor, turns_monitor):
    each = monitor_footprint(monitor_parts(rig_monitor, golden=False))
    turns = monitor_footprint(monitor_parts(turns_monitor, golden=False))
    high = [network.cycles("cortex_m4f")[2] for network in each.networks]
    saved = sum(high) - max(sum(high[first::3]) for first in range(3))
    assert each.cycles["cortex_m4f"][2] - turns.cycles["cortex_m4f"][2] == pytest.approx(saved, abs=1.0)
    assert turns.cycles["cortex_m4f"][0] < each.cycles["cortex_m4f"][0]
    assert turns.ram_bytes > each.ram_bytes


def test_the_footprint_is_that_of_the_code(c, folder, rig_monitor, tmp_path):
    c.need("gcc")
    counts = monitor_footprint(monitor_parts(rig_monitor, golden=False))
    (tmp_path / "size.c").write_text(
        '#include "watch.h"\n#include <stdio.h>\n'
        'int main(void) { (void)printf("%zu", sizeof(watch_state)); return 0; }\n'
    )
    c.run("gcc", "-std=c99", "-I", folder, tmp_path / "size.c", "-o", tmp_path / "size")
    assert counts.ram_bytes - STACK_BYTES == pytest.approx(int(c.run(tmp_path / "size")), rel=0.1)
    c.need("arm-none-eabi-gcc")
    objects = [tmp_path / f"{source}.o" for source in ("watch.c", *(f"watch_n{i}.c" for i in range(4)))]
    for path in objects:
        c.run("arm-none-eabi-gcc", *c.flags, "-O2", *M4, "-c", folder / path.name[:-2], "-o", path)
    told = c.run("arm-none-eabi-size", "-A", *objects).decode()
    constants = sum(int(size) for size in re.findall(r"^\.rodata\S*\s+(\d+)", told, re.MULTILINE))
    assert counts.constants == pytest.approx(constants, rel=0.05)
    facts = counts.to_json(Budget())
    assert [row["fits"] for row in facts["verdict"]] == [True] * 4
    low, typical, high = counts.cycles["cortex_m4f"]
    assert low < typical < high
    assert high > 1.4 * counts.chain.most > 1.4 * counts.chain.mean


def test_the_whole_self_test_passes_on_a_core_without_double_precision(c, folder, tmp_path):
    c.need("arm-none-eabi-gcc", "qemu-system-arm")
    board = Path(__file__).parent / "board"
    flags = ["-std=gnu99", "-O2", "-ffp-contract=off", *M4, "--specs=rdimon.specs", "-nostartfiles", "-I."]
    built = [*sources(folder), "host_test.c", board / "startup.c", "-lm", "-lrdimon", "-o", tmp_path / "image.elf"]
    c.run("arm-none-eabi-gcc", *flags, "-DCLOCK_HZ=25000000u", "-T", board / "mps2.ld", *built, folder=folder)
    emulator = ["qemu-system-arm", "-M", "mps2-an386", "-nographic", "-semihosting-config", "enable=on,target=native"]
    told = c.run(*emulator, "-kernel", "image.elf", folder=tmp_path).decode()
    assert "watch: all tests passed" in told
