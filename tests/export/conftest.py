"""Networks as C programs, and what runs them."""

from __future__ import annotations

import copy
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from torch.func import jvp

from edp.export.c.model import make_model
from edp.export.c.target import CTarget
from edp.export.golden import random_inputs
from edp.export.simulink import SimulinkTarget
from edp.networks.input_range import usual_range
from edp.networks.predictor import Predictor
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle

FLAGS = ("-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-ffp-contract=off")
OWN = ("predictor.c",)
NEEDED = {
    "gcc": "gcc libc6-dev",
    "clang": "clang",
    "cmake": "cmake make",
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "cppcheck": "cppcheck",
    "qemu-system-arm": "qemu-system-arm",
    "octave-cli": "octave",
    "mkoctfile": "octave-dev",
}


def need(*programs: str) -> None:
    """Skip where a program is missing, with the Debian packages that have it."""
    missing = [NEEDED[name] for name in programs if shutil.which(name) is None]
    if missing:
        pytest.skip(f"needs the Debian packages {' '.join(missing)} (make system-packages)")


def run(*command: object, folder: Path | None = None, feed: bytes = b"") -> bytes:
    """Standard output of a program that must end well."""
    done = subprocess.run([str(part) for part in command], cwd=folder, input=feed, capture_output=True)
    assert done.returncode == 0, (done.stdout + done.stderr).decode()[-3000:]
    return done.stdout


def stream_c(program: Path, inputs: np.ndarray) -> np.ndarray:
    """What an exported program predicts, ``(tick, number)``."""
    found = run(program, "stream", feed=np.ascontiguousarray(inputs, dtype=np.float32).tobytes())
    return np.frombuffer(found, dtype=np.float32).reshape(len(inputs), -1)


def sources_of(folder: Path) -> list[str]:
    """C files of an exported model and its runtime, without programs."""
    return sorted(path.name for path in folder.glob("*.c") if path.name in OWN or path.name.startswith("edp_"))


@pytest.fixture(scope="session")
def c() -> SimpleNamespace:
    """What tests need of compilers and programs."""
    return SimpleNamespace(flags=FLAGS, need=need, run=run, stream=stream_c, sources=sources_of)


@pytest.fixture(scope="session")
def bundle_of(predictor_of, integers_of) -> Callable[..., Bundle]:
    """The bundle of a small network of the registries, in single precision or integer (W8A16)."""

    def make(structure: str, whole: bool = False) -> Bundle:
        predictor = integers_of(structure) if whole else predictor_of(structure, dtype=torch.float32)
        task = predictor.task
        inputs = tuple(Channel(name, Kind.GENERIC, "an input") for name in task.inputs)
        return Bundle(predictor, inputs, (Kind.GENERIC,) * len(task.targets), tuple(f"{n} */" for n in task.targets))

    return make


@pytest.fixture(scope="session")
def program_of(bundle_of, tmp_path_factory) -> Callable[..., Path]:
    """The test program of an exported network; the runtime is compiled once for each set of flags."""
    runtimes: dict[tuple[str, ...], Path] = {}

    def make(structure: str, compiler: str = "gcc", *more: str, whole: bool = False) -> Path:
        need(compiler)
        folder = tmp_path_factory.mktemp("exported")
        bundle = bundle_of(structure, whole)
        CTarget().write(bundle, "predictor", folder)
        flags = (*FLAGS, *(more or ("-O1",)))
        key = (compiler, *flags, str(whole))
        if key not in runtimes:
            runtimes[key] = tmp_path_factory.mktemp("runtime")
            sources = [folder / name for name in make_model("predictor", bundle).runtime if name.endswith(".c")]
            run(compiler, *flags, "-c", *sources, folder=runtimes[key])
        objects = sorted(runtimes[key].glob("*.o"))
        sources = ["predictor.c", "host_test.c"]
        run(compiler, *flags, *sources, *objects, "-lm", "-o", "program", folder=folder)
        return folder / "program"

    return make


STEP = 1e-5


def random_changes(predictor, ticks, directions, seed=9):
    _, spread = usual_range(predictor)
    return np.random.default_rng(seed).normal(size=(ticks, directions, len(spread))) * spread


def differentiated(predictor, inputs, changes):
    """What PyTorch makes of the changes along one direction, in double precision, ``(tick, number)``.

    Forward-mode differentiation; a central difference where a recurrent layer has a backward pass of its own only.
    """
    exact = copy.deepcopy(predictor).double()

    def predictions(x):
        prediction, _ = exact.predict(x, exact.initial_state(1, x))
        parts = [prediction[0].flatten(1)]
        if exact.output.coverages:
            bounds, _ = exact.intervals(x, exact.initial_state(1, x))
            parts += [bounds[0, :, :, side].flatten(1) for side in (0, 1)]
        return torch.cat(parts, dim=1)

    x, dx = (torch.from_numpy(np.asarray(v, dtype=np.float64))[None] for v in (inputs, changes))
    try:
        return jvp(predictions, (x,), (dx,))[1].detach().numpy()
    except RuntimeError as error:
        if "autograd.Function" not in str(error):
            raise
    with torch.no_grad():
        return ((predictions(x + STEP * dx) - predictions(x - STEP * dx)) / (2 * STEP)).numpy()


@pytest.fixture(scope="session")
def changes_of() -> Callable[..., np.ndarray]:
    """Random changes of a network's inputs ``(tick, direction, input)``, as wide as the inputs themselves."""
    return random_changes


@pytest.fixture(scope="session")
def torch_changes() -> Callable[..., np.ndarray]:
    """How PyTorch's predictions change with inputs."""
    return differentiated


def run_octave(program: str, folder: Path) -> str:
    """What Octave prints."""
    need("octave-cli")
    script = folder / "program_of_the_test.m"
    script.write_text(program)
    done = subprocess.run(["octave-cli", "--norc", "--quiet", str(script)], capture_output=True, text=True, cwd=folder)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.fixture(scope="session")
def octave() -> Callable[[str, Path], str]:
    """What Octave prints of a program that runs in a folder."""
    return run_octave


def faulty(predictor: Predictor, ticks: int = 90) -> np.ndarray:
    """Inputs with bad ticks, single ones and a long run of them."""
    rows = random_inputs(predictor, ticks, seed=6).astype(float)
    rows[20, 0], rows[30, 1] = np.nan, np.inf
    rows[40:49] = np.nan
    rows[60, :] = 1e30
    return rows


@pytest.fixture(scope="session")
def hard_rows() -> Callable[..., np.ndarray]:
    """Inputs of a predictor with faults."""
    return faulty


@pytest.fixture(scope="session")
def onnx_session() -> Callable[[bytes], object]:
    """Sessions of ONNX Runtime in one thread."""
    runtime = pytest.importorskip("onnxruntime", reason="needs the package onnxruntime: the extra dev has it")

    def make(model: bytes) -> object:
        options = runtime.SessionOptions()
        options.intra_op_num_threads, options.log_severity_level = 1, 3
        return runtime.InferenceSession(model, options, providers=["CPUExecutionProvider"])

    return make


@pytest.fixture(scope="session")
def matlab_folder_of(bundle_of, tmp_path_factory) -> Callable[..., Path]:
    """Folders for MATLAB as they are exported, by network."""
    made: dict[tuple[str, bool], Path] = {}

    def make(structure: str, whole: bool = False) -> Path:
        if (structure, whole) not in made:
            pytest.importorskip("onnx", reason="needs the package onnx: the extra dev has it")
            folder = tmp_path_factory.mktemp("simulink")
            SimulinkTarget().write(bundle_of(structure, whole), "arm", folder)
            made[structure, whole] = folder
        return made[structure, whole]

    return make


@pytest.fixture(scope="session")
def exported_plan(c, tmp_path_factory):
    """A predictive controller that was run, exported and compiled: see `exported_run`."""
    pytest.importorskip("daqp", reason="the solver is an optional package")
    c.need("gcc")
    from exported_controllers import exported_run

    return exported_run(c, tmp_path_factory.mktemp("plan"), "nmpc")


@pytest.fixture(scope="session")
def exported_grey(c, tmp_path_factory):
    """A predictive controller on a grey box, in the same way."""
    pytest.importorskip("daqp", reason="the solver is an optional package")
    c.need("gcc")
    from exported_controllers import exported_run

    return exported_run(c, tmp_path_factory.mktemp("grey"), "nmpc", grey=True)


@pytest.fixture(scope="session")
def exported_loop(c, tmp_path_factory):
    """A PI loop, in the same way."""
    c.need("gcc")
    from exported_controllers import exported_run

    return exported_run(c, tmp_path_factory.mktemp("loop"), "pi")


@pytest.fixture(scope="session")
def rig_monitor():
    """A monitor of the small rig, see `small_monitors`."""
    from small_monitors import fitted_monitor

    return fitted_monitor()


@pytest.fixture(scope="session")
def rig_fault(rig_monitor):
    """Rows of a session of the rig whose head pressure sensor reads too high from its middle on."""
    from edp.testing.monitor import rig_sessions

    (session,) = rig_sessions(1, 3000, seed=1, first=20)
    rows = session.select(rig_monitor.inputs).copy()
    rows[1000:, rig_monitor.inputs.index("pressure_a")] += 2e6
    return rows
