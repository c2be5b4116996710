"""Compiled code of grey boxes, kept on disk by the sources of this folder."""

from __future__ import annotations

from pathlib import Path

from edp.storage.machine_code import Compiler, files_with

_FOLDER = Path(__file__).parent
# No "nnan" and "ninf": numbers that are not finite must stay visible.
_FASTMATH = {"nsz", "arcp", "contract", "afn", "reassoc"}
compiler = Compiler(
    "grey",
    lambda: (_FOLDER / "layout.py", *files_with(_FOLDER, "from edp.networks.twin.grey.jit import")),
    {"nogil": True, "error_model": "numpy", "fastmath": _FASTMATH},
)
compiled, inlined, inner = compiler.compiled, compiler.inlined, compiler.inner
