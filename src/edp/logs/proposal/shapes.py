"""Tables that are no logs with a channel a column, though their numbers can be read: what a person is told of them."""

from __future__ import annotations

import numpy as np

from edp.logs.proposal.columns import LogLook

_LEAST_COLUMNS = 20
"""Columns without names from which a row may hold samples of one signal."""
_ALIKE, _MOST = 0.97, 0.9
"""Correlation of neighbours that continue each other, and share of the neighbours that do."""


def shape_notes(look: LogLook) -> list[str]:
    """What speaks against a table being a log with a channel a column.

    Args:
        look: what was looked at.
    """
    if look.headerless and len(look.columns) >= _LEAST_COLUMNS and _neighbours_continue(look):
        return [
            f"{len(look.columns)} columns without names, each nearly the one before: a row seems to hold samples of "
            "one signal, as a cycle of a test rig does; write one signal a column, its samples below each other"
        ]
    return []


def _neighbours_continue(look: LogLook) -> bool:
    values = np.stack([column.pieces[0] for column in look.columns])
    values = values[:, np.isfinite(values).all(axis=0)]
    if values.shape[1] < 3:
        return False
    moved = values - values.mean(axis=1, keepdims=True)
    size = np.sqrt(np.mean(moved**2, axis=1))
    if not size.all():
        return False
    alike = np.mean(moved[1:] * moved[:-1], axis=1) / (size[1:] * size[:-1])
    return bool(np.mean(alike > _ALIKE) > _MOST)
