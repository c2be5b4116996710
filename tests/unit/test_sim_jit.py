import importlib
from pathlib import Path
from types import ModuleType

import numpy as np
from numba.core.dispatcher import Dispatcher

from edp.sim import scenario_file
from edp.sim.physics import jit


def test_compiles_without_a_writable_cache(monkeypatch, tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(blocked))
    jit.cache_folder.cache_clear()
    try:
        assert jit.cache_folder() is None

        @jit.compiled
        def double(x: float) -> float:
            return 2.0 * x

        assert double(1.5) == 3.0
    finally:
        monkeypatch.undo()
        jit.cache_folder.cache_clear()


def test_cache_folder_is_keyed_to_the_sources(monkeypatch, tmp_path):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    jit.cache_folder.cache_clear()
    try:
        folder = jit.cache_folder()
        assert folder is not None
        assert folder.parent == tmp_path
        assert folder.is_dir()
    finally:
        monkeypatch.undo()
        jit.cache_folder.cache_clear()


def test_compiled_code_uses_nothing_outside_the_files_of_the_fingerprint():
    known = {path.resolve() for path in jit.fingerprinted()}
    assert {path.name for path in known} >= {"jit.py", "layout.py", "integrator.py", "plant.py", "terramechanics.py"}
    assert Path(scenario_file.__file__) not in known
    root = Path(jit.__file__).resolve().parents[1]
    for path in known:
        module = importlib.import_module(".".join(["edp.sim", *path.relative_to(root).with_suffix("").parts]))
        for function in vars(module).values():
            if not isinstance(function, Dispatcher):
                continue
            for name in function.py_func.__code__.co_names:
                used = function.py_func.__globals__.get(name)
                if isinstance(used, Dispatcher):
                    used = importlib.import_module(used.py_func.__module__)
                if isinstance(used, ModuleType) and used.__name__.startswith("edp."):
                    assert Path(used.__file__).resolve() in known, f"{path.name}: {name}"


def test_not_a_number_stays_visible():
    @jit.compiled
    def echo(x: float) -> bool:
        return np.isnan(x)

    assert echo(float("nan"))
