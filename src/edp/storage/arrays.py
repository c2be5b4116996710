"""Numeric arrays in JSON files."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import StorageError


def numbers_in(value: Any, where: str, shape: tuple[int, ...] | None = None) -> NDArray[np.float64]:
    """Convert nested lists of a JSON file to a numeric array.

    Args:
        value: the lists, or one number.
        where: file and key, for the message.
        shape: expected shape; None accepts any.

    Raises:
        StorageError: an entry is not a finite number, lists have unequal lengths, or the shape is another one.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = np.array(np.nan)
    if isinstance(value, str) or not np.isfinite(array).all():
        raise StorageError(f"{where} is damaged: got something other than finite numbers; restore it or write it again")
    if shape is not None and array.shape != shape:
        raise StorageError(
            f"{where} is damaged: got shape {array.shape}, expected {shape}; restore it or write it again"
        )
    return array
