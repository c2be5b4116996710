"""Exported controllers for tests: a run of edp loop run with a small twin, its C code as a library, and the library."""

from __future__ import annotations

import ctypes
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from edp.config.control import load_control_experiment
from edp.testing.control import sample_grey_box, sample_recurrent_twin
from edp.training.twin_bundle import save_twin
from edp.workflows.control import ControlSources, control_loops, export_controller

UNITS = 8
"""Of the twin: a tick of the plan in Python takes milliseconds whatever it is."""
TASK = {"kind": "grade", "length_m": [0.4, 0.5], "speed_m_s": 0.5, "lead_s": 0.3, "hold_s": 0.2}
SOLVER = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-O2")
"""DAQP's own files convert numbers implicitly."""


def control_run(folder: Path, kind: str, options: dict | None = None, grey: bool = False) -> Path:
    """A finished run of one loop on the simulator; `grey`: a plan on a grey box."""
    twin = None
    if kind == "nmpc":
        twin = save_twin(sample_grey_box(is_fitted=True) if grey else sample_recurrent_twin(UNITS), folder / "twin")
    settings = {"controller": {"kind": kind, **(options or {})}, "loops": 1, "task": TASK}
    control_loops(load_control_experiment(None, [], settings), folder / "run", ControlSources(twin=twin))
    return folder / "run"


def sources_of(folder: Path, name: str = "machine") -> list[str]:
    """C files of an exported controller, as its CMake file lists them."""
    text = (folder / "CMakeLists.txt").read_text()
    return re.search(rf"add_library\({name}_control STATIC (.*)\)", text)[1].split()


def compiled(c, folder: Path, into: Path, compiler: str = "gcc", *flags: str) -> list[Path]:
    """Objects of a controller: its own files with all warnings as errors, the solver's with most."""
    into.mkdir(exist_ok=True)
    objects = []
    for source in sources_of(folder):
        own = () if source.startswith("daqp/") else c.flags
        target = into / f"{Path(source).stem}.o"
        c.run(compiler, *SOLVER, *own, *flags, "-fPIC", "-c", source, "-o", target, folder=folder)
        objects.append(target)
    return objects


def library_of(c, folder: Path, into: Path) -> Path:
    """A controller as a shared library."""
    objects = compiled(c, folder, into)
    c.run("gcc", "-shared", *objects, "-lm", "-o", into / "lib.so")
    return into / "lib.so"


class Compiled:
    """A controller in C with the interface of `edp.control.base.Controller`, as far as a loop needs it.

    Args:
        library: shared library of the controller.
        kept: the controller in Python.
        reads: channels that it reads.
    """

    class Reference(ctypes.Structure):
        """``edp_reference``."""

        _fields_ = (("ticks", ctypes.c_uint32), ("strokes", ctypes.c_void_p), ("tip", ctypes.c_void_p))

    def __init__(self, library, plant, reads, name="machine"):
        self.plant, self.events, self.info = plant, [], {}
        self._columns = plant.columns(reads)
        loaded = ctypes.CDLL(str(library))
        self.begin, self._step, self.missed = (loaded[f"{name}_control_{way}"] for way in ("begin", "step", "missed"))
        # Far more than any state here: C says how large it is in a header only.
        self.state = ctypes.create_string_buffer(1_000_000)
        self.statuses = []

    def reset(self, observation, reference):
        self._rows = [np.ascontiguousarray(rows, np.float32) for rows in (reference.strokes, reference.tip)]
        self._reference = self.Reference(reference.ticks, *(rows.ctypes.data for rows in self._rows))
        self.statuses = []
        return self.begin(self.state, self._row(observation), ctypes.byref(self._reference))

    def step(self, observation, tick, *verdict):  # exported code has no guard
        levers = np.full(3, np.nan, np.float32)
        self.statuses.append(self._step(self.state, self._row(observation), levers.ctypes.data_as(ctypes.c_void_p)))
        return levers.astype(float)

    def _row(self, observation):
        self._last = np.ascontiguousarray(np.asarray(observation)[self._columns], np.float32)
        return self._last.ctypes.data_as(ctypes.c_void_p)


def exported_run(c, root: Path, kind: str, grey: bool = False) -> SimpleNamespace:
    """A run, its export and its library."""
    run = control_run(root, kind, grey=grey)
    files = export_controller(run, root / "c", "machine")
    library = library_of(c, root / "c", root / "objects")
    return SimpleNamespace(run=run, folder=root / "c", files=files, library=library, kind=kind)
