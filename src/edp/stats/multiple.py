"""Adjustment of p-values for the number of registered modules, including modules dropped earlier."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import ArrayLike

from edp.errors import DataError, closest
from edp.stats.checks import Array, finite


def benjamini_hochberg(p: ArrayLike) -> Array:
    """Return p-values adjusted after Benjamini and Hochberg (1995), over the last axis.

    They control the false discovery rate: the expected fraction of false positives among the confirmed modules. This
        equals the probability of any false positive only if no module has an effect; `holm` always bounds that
        probability.

    Raises:
        DataError: empty, or values outside 0 to 1.
    """
    from scipy.stats import false_discovery_control  # late: see edp.stats.effects

    array, _, _ = _sort_p_values(p)
    return np.asarray(false_discovery_control(array, axis=-1, method="bh"), dtype=np.float64)


def holm(p: ArrayLike) -> Array:
    """Return p-values adjusted after Holm (1979), over the last axis: the probability of any false confirmation.

    Raises:
        DataError: empty, or values outside 0 to 1.
    """
    array, order, n = _sort_p_values(p)
    scaled = np.take_along_axis(array, order, axis=-1) * np.arange(n, 0, -1)
    # Steps down: no p-value may be adjusted below that of a smaller one.
    return _restore_order(np.minimum(np.maximum.accumulate(scaled, axis=-1), 1.0), order)


def adjust_registered(p: Mapping[str, float], registered: Iterable[str]) -> dict[str, float]:
    """Apply Benjamini-Hochberg to all registered modules; a module without a test has p = 1.

    An adjustment only for the modules that passed a screening would ignore the other tests on the same sessions.

    Args:
        p: raw p-values of the modules that were tested.
        registered: every module of the study, fixed before its first run.

    Raises:
        DataError: a tested module is not registered, one is registered twice, or p is outside 0 to 1.
    """
    names = list(registered)
    if len(set(names)) != len(names):
        raise DataError("a module is registered twice; give each once")
    for name in p:
        if name not in names:
            raise DataError(f"module '{name}' has a p-value but is not registered{closest(name, names)}")
    adjusted = benjamini_hochberg([p.get(name, 1.0) for name in names])
    return {name: float(value) for name, value in zip(names, adjusted)}


def _sort_p_values(p: ArrayLike) -> tuple[Array, np.ndarray, int]:
    array = finite(p, "list of p-values", 1)
    if (array < 0.0).any() or (array > 1.0).any():
        raise DataError("p-values must lie between 0 and 1")
    return array, np.argsort(array, axis=-1, kind="stable"), array.shape[-1]


def _restore_order(values: Array, order: np.ndarray) -> Array:
    result = np.empty_like(values)
    np.put_along_axis(result, order, values, axis=-1)
    return result
