"""Compiling the simulator's inner loops; its cache is filled by one process."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from edp.signals import GROUND_POINTS
from edp.storage.machine_code import Compiler, files_with
from edp.storage.paths import is_there
from edp.storage.portable import lock as lock_file

# No reference counts ("_nrt"): compiled functions read and write arrays of their callers and allocate none. Counting
# references to them, with atomic operations at every use, took 40 % of a step.
OPTIONS = {"_nrt": False}


def fingerprinted() -> tuple[Path, ...]:
    """Return the source files that compiled code depends on: importers of this module, layout modules, this file."""
    room = Path(__file__).parents[1]
    places = room / "machine" / "layout.py", room / "physics" / "scratch.py"
    return (*files_with(room, "from edp.sim.physics.jit import"), *places, Path(__file__))


compiler = Compiler("sim", fingerprinted, str(GROUND_POINTS), OPTIONS)
compiled, inlined = compiler.compiled, compiler.inlined
# Pasted into callers before these are compiled: without reference counts, no others may return parts of arrays.
pasted = Compiler("sim", fingerprinted, str(GROUND_POINTS), {**OPTIONS, "inline": "always"}).compiled


class WarmUp:
    """Compiles everything of a part once for each cache folder, in one process, in one order.

    What a caller's machine code looks like depends on whether the functions it calls were compiled in the same process
    or loaded. Processes that fill an empty cache side by side would each run their own variant, and the last bits of
    their results would differ.

    Args:
        part: name of the file that marks the cache of this part as filled.
    """

    def __init__(self, part: str) -> None:
        self.part, self._begun = part, False

    def once(self, play: Callable[[], None]) -> None:
        """Run `play`, which calls all compiled code, where this cache was not filled before; others wait for it."""
        if self._begun:
            return
        self._begun = True
        folder = compiler.folder
        if folder is None:
            play()
            return
        complete = folder / self.part
        if is_there(complete):
            return
        with (folder / "lock").open("w") as lock:
            lock_file(lock, wait=True)
            # Asked again under the lock: another process may have filled the cache meanwhile.
            if not is_there(complete):
                play()
                # Marked last: a rehearsal that was killed is repeated.
                complete.touch()


rehearsal = WarmUp("complete")
motor_rehearsal = WarmUp("motors")
episode_rehearsal = WarmUp("episodes")
"""Both apart, and after the first: who needs neither shall not wait for them."""
