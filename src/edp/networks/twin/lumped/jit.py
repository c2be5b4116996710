"""Compiled code of tanks, masses and lags, cached on disk by its sources."""

from __future__ import annotations

from pathlib import Path

from edp.storage.machine_code import Compiler, files_with

_FOLDER = Path(__file__).parent
compiler = Compiler(
    "lumped",
    lambda: (_FOLDER / "constants.py", *files_with(_FOLDER, "from edp.networks.twin.lumped.jit import")),
)
compiled, inner = compiler.compiled, compiler.inner
