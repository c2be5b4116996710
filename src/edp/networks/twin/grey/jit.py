"""Compiled code of grey boxes, cached on disk by the sources of this folder."""

from __future__ import annotations

from pathlib import Path

from edp.storage.machine_code import Compiler, files_with

_FOLDER = Path(__file__).parent
compiler = Compiler(
    "grey",
    # The correction network of a grey box uses the cell of the recurrent twin.
    lambda: (
        _FOLDER / "parameter_index.py",
        _FOLDER / "equations.py",
        _FOLDER.parent / "symbolic" / "expression.py",
        _FOLDER.parent / "symbolic" / "machine_code.py",
        _FOLDER.parent / "steps.py",
        *files_with(_FOLDER, "from edp.networks.twin.grey.jit import"),
    ),
)
compiled, inlined, inner = compiler.compiled, compiler.inlined, compiler.inner
