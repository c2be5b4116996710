"""Compilation of the simulator's inner loops."""

from __future__ import annotations

from pathlib import Path

from edp.signals import GROUND_POINTS
from edp.storage.machine_code import Compiler, files_with

# No reference counts ("_nrt"): compiled functions read and write arrays of their callers and allocate none. Counting
# references to them, with atomic operations at every use, took 40 % of a step.
OPTIONS = {"_nrt": False}


def list_sources() -> tuple[Path, ...]:
    """Return the source files that compiled code depends on: importers of this module, layout modules, this file."""
    room = Path(__file__).parents[1]
    places = room / "machine" / "layout.py", room / "physics" / "scratch.py"
    return (*files_with(room, "from edp.sim.physics.jit import"), *places, Path(__file__))


compiler = Compiler("sim", list_sources, str(GROUND_POINTS), OPTIONS)
compiled, inlined = compiler.compiled, compiler.inlined
# Pasted into callers before these are compiled: without reference counts, no others may return parts of arrays.
pasted = Compiler("sim", list_sources, str(GROUND_POINTS), {**OPTIONS, "inline": "always"}).compiled
