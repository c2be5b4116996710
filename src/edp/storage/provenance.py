"""Environment of a result: versions, machine and command; see `edp.settings.provenance`."""

from __future__ import annotations

import platform
import sys
from importlib import metadata
from pathlib import Path

PROVENANCE = "provenance.json"
RECORDED = ("torch", "numpy", "scipy", "numba", "scikit-learn", "safetensors")
"""Libraries whose versions can change a result."""


def environment(threads: int) -> dict[str, str]:
    """Return versions and machine properties that can change a result, as flat strings."""
    facts = {"python": platform.python_version(), "machine": platform.machine(), "system": platform.system()}
    for name in RECORDED:
        try:
            facts[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            # Also a fact: without a library another way may be taken.
            facts[name] = "absent"
    # The number of threads changes the order of sums, and so their last bits.
    return facts | {"threads": str(threads)}


def command_line() -> str:
    """Return the command line of this process as a user would type it."""
    return " ".join([Path(sys.argv[0]).name, *sys.argv[1:]])
