"""Conversion from and to pandas and Polars data frames; both libraries are imported on first use only."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError


def frame_library(name: str) -> ModuleType:
    """Return the pandas or polars.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise ConfigError(f"{name} is not installed; install it (pip install {name}), or use NumPy arrays") from error


def frame_of(library: str, columns: Mapping[str, NDArray[Any] | list[Any]]) -> Any:
    """Create a ``pandas`` or ``polars`` data frame from columns.

    Raises:
        ConfigError: the library is not installed.
    """
    return frame_library(library).DataFrame(dict(columns))


class OneFrame(ABC):
    """Base class of results that are one table, convertible to a data frame."""

    @abstractmethod
    def _columns(self) -> Mapping[str, NDArray[Any] | list[Any]]:
        """Return the columns by name, all of one length."""

    def to_pandas(self) -> Any:
        """Return one pandas frame with the columns that the class lists.

        Raises:
            ConfigError: pandas is not installed.
        """
        return frame_of("pandas", self._columns())

    def to_polars(self) -> Any:
        """Return the table as a Polars data frame.

        Raises:
            ConfigError: Polars is not installed.
        """
        return frame_of("polars", self._columns())


def columns_of(frame: Any, where: str) -> dict[str, NDArray[Any]]:
    """Return the columns of a frame by name, each ``(time,)``.

    Raises:
        DataError: it is no frame, or a name is no text or stands twice.
    """
    names = getattr(frame, "columns", None)
    if names is None or not hasattr(frame, "__getitem__"):
        raise DataError(f"{where} is a {type(frame).__name__}; give a pandas or Polars DataFrame")
    names = list(names)
    unnamed = [name for name in names if not isinstance(name, str)]
    if unnamed:
        raise DataError(f"{where}: column {str(unnamed[0])[:40]} is not named by a text; rename it")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise DataError(f"{where}: column '{twice[0]}' occurs twice; rename one of them")
    return {name: _numpy(frame[name]) for name in names}


def _numpy(column: Any) -> NDArray[Any]:
    """Return the values of a column; missing integers, which NumPy cannot hold, become NaN."""
    # Object columns hold Python values, such as None beside integers.
    values = np.asarray(column.to_numpy())
    if values.dtype != object:
        return values
    try:
        return np.array([np.nan if _missing(value) else value for value in values], dtype=np.float64)
    except (TypeError, ValueError):
        return values


def _missing(value: Any) -> bool:
    """Return whether a value is None or pandas' NA, which does not equal itself."""
    # Compared by name: pandas is not imported where a user has only Polars.
    return value is None or type(value).__name__ == "NAType"
