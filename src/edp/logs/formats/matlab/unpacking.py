"""Unpacking a MAT file whole, in the process that calls it: damaged ones crash, hang or exhaust the libraries.

Logs are therefore opened by `edp.logs.open_log`, which calls this in a sandbox.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import scipy.io

from edp.errors import DataError, brief
from edp.logs.formats.matlab.check import check_size
from edp.logs.formats.matlab.experiments import experiment_names, pick_experiment
from edp.logs.formats.matlab.library import matio
from edp.logs.formats.matlab.objects import collect
from edp.logs.formats.matlab.sigstream import place_streams, variable_names
from edp.logs.formats.matlab.variables import INFO, MAGIC, MatVariables, is_v4
from edp.storage.memory import announce

COPIES = 8
"""Memory in bytes per byte of unpacked variables, because the libraries copy them several times."""
OBJECT_BYTES = 8192
"""Memory in bytes per HDF5 object in the library: handles, attributes and references."""


def unpack(path: Path, variable: str | None = None) -> MatVariables:
    """Return all variables of a file, or a single variable.

    Args:
        path: the file.
        variable: read this one only, or one experiment of several in it (``train{2}``).

    Raises:
        DataError: the file is damaged or holds more than this machine's memory.
    """
    variables = _load(path)
    info = variables.pop(INFO, None)
    names, every = list(variables), variables
    if variable is not None:
        picked = None if variable in variables else pick_experiment(variables, variable)
        names += [] if picked is None else [variable]
        variables = picked or {name: value for name, value in variables.items() if name == variable}
    mat_variables = collect(variables)
    mat_variables.names = names
    # Of a variable that is not there all are named, so that a message can tell which ones are.
    mat_variables.experiment_names = experiment_names(variables or every)
    if info is not None:
        array = np.asarray(info)
        mat_variables.info = str(array.ravel()[0]) if array.size else ""
    return mat_variables


def _load(path: Path) -> dict[str, object]:
    with path.open("rb") as stream:
        head = stream.read(128)
    # A file that is cut off inside its header begins like one.
    if any(magic.startswith(head[: len(magic)]) for magic in MAGIC) and len(head) < 128:
        raise DataError(f"'{path}' is a MAT file that ends inside its header (truncated); copy or export it again")
    memory_bytes, objects = (path.stat().st_size, 1) if is_v4(head) else check_size(path)
    announce(memory=COPIES * memory_bytes + objects * OBJECT_BYTES, work=memory_bytes, parts=objects)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if is_v4(head):
                variables = scipy.io.loadmat(str(path))
            else:
                # The library takes the group of streamed signals for a variable of no class.
                streamed = variable_names(path)
                variables = matio.load_from_mat(str(path), add_table_attrs=True, variable_names=streamed)
                if streamed is not None:
                    place_streams(path, variables)
        except DataError:
            raise
        except Exception as error:
            # The parsers meet damaged bytes with any exception there is; every one means the same to the user.
            raise DataError(
                f"'{path}' cannot be read as a MAT file ({type(error).__name__}: {brief(error)}); it may be truncated "
                "or damaged: copy or export it again"
            ) from error
    # The library warns and leaves the object out: its signals would be missing unnoticed.
    failed = [str(item.message) for item in caught if "Failed to load" in str(item.message)]
    if failed:
        raise DataError(
            f"'{path}': an object in this MAT file is damaged ({brief(failed[0])}); copy or export it again"
        )
    nameless = [name for name in variables if not isinstance(name, str)]
    if nameless:
        raise DataError(
            f"'{path}' holds a variable whose name is no text ({nameless[0]!r}); it is damaged: copy or export it again"
        )
    return {name: value for name, value in variables.items() if not name.startswith("__")}
