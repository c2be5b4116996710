"""Compiled code of plans on grey boxes, cached separately so that fits and plans do not wait for each other."""

from __future__ import annotations

from pathlib import Path

from edp.networks.twin.grey.jit import compiler as whole
from edp.storage.machine_code import Compiler, files_with

_FOLDER = Path(__file__).parent
compiler = Compiler(
    "grey_near",
    lambda: (*whole.sources(), *files_with(_FOLDER, "from edp.networks.twin.grey.near_jit import")),
)
compiled, inner = compiler.compiled, compiler.inner
