"""Rights of files that hold for tests that run as root, too."""

from __future__ import annotations

import ctypes
import os

PR_CAPBSET_DROP = 24
OVERRIDES = (1, 2)
"""CAP_DAC_OVERRIDE and CAP_DAC_READ_SEARCH: by these root reads and writes what its rights forbid."""


def hold_root_to_rights() -> None:
    """Let programs that this process starts as root be held to the rights of files; for ``preexec_fn``."""
    if os.geteuid() == 0:
        library = ctypes.CDLL(None, use_errno=True)
        for capability in OVERRIDES:
            library.prctl(PR_CAPBSET_DROP, capability, 0, 0, 0)
