"""Environment of processes that handle what strangers made: variables that Python and its libraries need, no others.

A variable may hold a secret (``AWS_SECRET_ACCESS_KEY``, tokens of build systems), so the names are a list of what is
passed on rather than a list of what is removed.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping

_NAMES = frozenset(
    (
        # The system: programs, the home folder (caches of libraries), temporary files, shared libraries.
        "PATH", "HOME", "USER", "LOGNAME", "TMPDIR", "TMP", "TEMP", "LD_LIBRARY_PATH", "DYLD_LIBRARY_PATH",
        "DYLD_FALLBACK_LIBRARY_PATH", "XDG_CACHE_HOME",
        # Windows: Python does not start without some of them.
        "SYSTEMROOT", "SYSTEMDRIVE", "WINDIR", "COMSPEC", "PATHEXT", "USERPROFILE", "APPDATA", "LOCALAPPDATA",
        "PROGRAMDATA", "NUMBER_OF_PROCESSORS", "PROCESSOR_ARCHITECTURE",
        # Language and time zone.
        "LANG", "LANGUAGE", "TZ", "TZDIR",
        # Python.
        "PYTHONHOME", "PYTHONPATH", "PYTHONHASHSEED", "PYTHONUTF8", "PYTHONIOENCODING", "PYTHONDONTWRITEBYTECODE",
        "PYTHONPYCACHEPREFIX", "PYTHONNOUSERSITE", "PYTHONMALLOC", "PYTHONFAULTHANDLER", "PYTHONWARNINGS",
        "VIRTUAL_ENV",
        # Libraries of formats: locking of HDF5 files on network drives.
        "HDF5_USE_FILE_LOCKING",
    )
)  # fmt: skip
_PREFIXES = ("LC_", "MALLOC_", "MIMALLOC_", "OMP_", "MKL_", "OPENBLAS_", "NUMBA_", "EDP_")
"""Prefixes of the inherited variables: languages, allocators, thread counts, compiled code, EDP's own settings."""
BUILD_NAMES = frozenset(
    (
        "CC", "CXX", "CFLAGS", "CXXFLAGS", "CPPFLAGS", "LDFLAGS", "CPATH", "C_INCLUDE_PATH", "LIBRARY_PATH",
        "PKG_CONFIG_PATH", "CMAKE_PREFIX_PATH", "AMENT_PREFIX_PATH", "COLCON_PREFIX_PATH", "ROS_DISTRO", "ROS_VERSION",
        "ROS_PYTHON_VERSION", "ROS_DOMAIN_ID", "OCTAVE_HOME", "OCTAVE_EXEC_HOME", "WINEPREFIX",
    )
)  # fmt: skip
"""Additional variables for compilers, ROS 2 and Octave."""


def reduce_environment(further: Iterable[str] = ()) -> Mapping[str, str]:
    """Return the variables of this process that a process for hostile input may have.

    Args:
        further: names that are passed on in addition.
    """
    names = _NAMES | set(further)
    # Windows takes names in any case, and Python states them in capitals there.
    return {name: value for name, value in os.environ.items() if name in names or name.startswith(_PREFIXES)}
