import importlib
import os
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from numba.core.dispatcher import Dispatcher

from edp.data.screening import compiled as screening
from edp.sim import scenario_file
from edp.sim.physics import jit
from edp.storage import machine_code
from edp.storage.machine_code import Compiler, files_with


@pytest.fixture
def compiler(tmp_path, monkeypatch):
    """A compiler of one source file in a package of its own, with its cache below ``cache``."""
    (tmp_path / "package").mkdir()
    source = tmp_path / "package" / "a.py"
    source.write_text("a = 1")
    monkeypatch.setattr(machine_code, "PACKAGE", tmp_path)
    monkeypatch.setattr(machine_code, "__file__", str(source))
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    return lambda facts="": Compiler("part", lambda: (source,), facts)


def double(x: float) -> float:
    return 2.0 * x


def test_compiles_without_a_writable_cache(compiler, monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocked))
    without = compiler()
    assert without.folder is None
    assert without.compiled(double)(1.5) == 3.0


def test_code_is_kept_in_the_cache_folder_and_nowhere_else(compiler, tmp_path):
    assert compiler().compiled(double)(1.5) == 3.0
    (folder,) = (tmp_path / "cache").iterdir()
    assert folder.name.startswith("part-")
    assert list(folder.rglob("*.nbi"))
    assert not list(Path(__file__).parent.rglob("test_sim_jit.double*.nbi"))


def test_cache_folder_is_keyed_to_the_sources(compiler, tmp_path):
    first = compiler().folder
    assert first == compiler().folder
    assert first != compiler("a constant").folder
    (tmp_path / "package" / "a.py").write_text("a = 2")
    assert first != compiler().folder


def test_files_are_found_by_a_line_of_code(tmp_path):
    (tmp_path / "room").mkdir()
    for name in ("room/b.py", "a.py"):
        (tmp_path / name).write_text("from x import y\n")
    (tmp_path / "c.py").write_text("from x import z\n")
    assert files_with(tmp_path, "from x import y") == (tmp_path / "a.py", tmp_path / "room" / "b.py")


SIMULATOR = {"jit.py", "layout.py", "integrator.py", "plant.py", "terramechanics.py"}
SCREENING = {"compiled.py", "forest.py", "information.py", "ranks.py"}


@pytest.mark.parametrize(("part", "names"), [(jit, SIMULATOR), (screening, SCREENING)])
def test_compiled_code_uses_nothing_outside_the_files_of_the_fingerprint(part, names):
    known = {path.resolve() for path in part.compiler.sources()}
    assert {path.name for path in known} >= names
    assert Path(scenario_file.__file__) not in known
    root = Path(machine_code.__file__).resolve().parents[2]
    for path in known:
        module = importlib.import_module(".".join(path.relative_to(root).with_suffix("").parts))
        for function in vars(module).values():
            if not isinstance(function, Dispatcher):
                continue
            for name in function.py_func.__code__.co_names:
                used = function.py_func.__globals__.get(name)
                if isinstance(used, Dispatcher):
                    used = importlib.import_module(used.py_func.__module__)
                if isinstance(used, ModuleType) and used.__name__.startswith("edp."):
                    assert Path(used.__file__).resolve() in known, f"{path.name}: {name}"


def test_no_compiled_code_reorders_or_fuses_operations():
    assert "fastmath" not in machine_code.OPTIONS
    texts = {path: path.read_text() for path in Path(machine_code.__file__).parents[1].rglob("*.py")}
    assert [path.name for path, text in texts.items() if "import numba" in text] == ["machine_code.py"]
    assert [path.name for path, text in texts.items() if "fastmath=" in text or '"fastmath":' in text] == []


FIRST_CALLS = """
import hashlib
import numpy as np
from edp.sim import Scenario
from edp.sim.machine.machine_files import load_machine
from edp.sim.machine.parameters import pack
from edp.sim.physics.pose import Kinematics
from edp.sim.simulate import simulate
from edp.testing.bench import bench_channels, bench_grey_box, bench_series
from edp.networks.twin import fit_scales
from edp.networks.twin.greybox import GreyFitSpec
from edp.training.grey_fit import fit_grey_box

kinematics = Kinematics(*pack(load_machine("M22")))
print(kinematics.strokes(kinematics.poses(np.linspace(0.1, 1.0, 300).reshape(100, 3))).tobytes().hex())
for excitation, material in (("combined", ""), ("dig", "clay"), ("six_levers", "")):
    state = simulate(Scenario(excitation=excitation, duration_s=2.0, **({"material": material} if material else {})))
    print(hashlib.sha256(state.values.tobytes()).hexdigest())
fit = GreyFitSpec(lengths_s=(0.1,), rounds=(2,), final_rounds=2, batch=8, ticks=200, final_ticks=200, validation_s=0.5)
series = [bench_series(seed=seed) for seed in range(3)]
twin = bench_grey_box(prefix_ticks=30, fit=fit).start(bench_channels(), fit_scales(bench_channels(), series), series, 0)
fitted = fit_grey_box(twin, series[:2], series[2:], seed=0)
print(hashlib.sha256(fitted.theta.tobytes() + fitted.information.tobytes()).hexdigest())
"""


@pytest.mark.slow
@pytest.mark.processes
def test_the_first_process_of_an_installation_computes_the_bits_of_later_ones(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    first, second = (
        subprocess.run([sys.executable, "-c", FIRST_CALLS], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    )
    assert len(first.stdout.splitlines()) == 5
    assert second.stdout == first.stdout


def test_not_a_number_stays_visible():
    @jit.compiled
    def echo(x: float) -> bool:
        return np.isnan(x)

    assert echo(float("nan"))


AHEAD = "from edp.workflows.compile_ahead import compile_ahead; compile_ahead()"
FIRST_USE = """
from numba.core import event
compiled = []
class Compilations(event.Listener):
    def on_start(self, event):
        compiled.append(event.data["dispatcher"].py_func.__qualname__)
    def on_end(self, event):
        pass
with event.install_listener("numba:compile", Compilations()):
    from edp.workflows.compile_ahead import compile_ahead
    compile_ahead()
print(compiled)
"""


@pytest.mark.slow
def test_code_compiled_ahead_is_not_compiled_again(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", AHEAD], env=environment, check=True)
    second = subprocess.run(
        [sys.executable, "-c", FIRST_USE], env=environment, check=True, capture_output=True, text=True
    )
    assert second.stdout.strip() == "[]"
