"""Clusters of collinear channels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from edp.data.screening.result import Array


def clusters_of(spearman: Array, least: float) -> list[list[int]]:
    """Return groups in which every pair of channels has an absolute rank correlation of at least `least`.

    Complete linkage is used.

    Args:
        spearman: ``(channel, channel)``, finite.
        least: bound, 0 to 1.

    Returns:
        Groups of one or more columns, each sorted, by their first column.
    """
    count = len(spearman)
    if count == 1:
        return [[0]]
    distance = 1.0 - np.abs(spearman)
    # SciPy asks for an exactly symmetric matrix without negative rounding.
    distance = np.maximum(0.5 * (distance + distance.T), 0.0)
    np.fill_diagonal(distance, 0.0)
    labels = fcluster(linkage(squareform(distance, checks=False), "complete"), 1.0 - least, "distance")
    groups = [np.flatnonzero(labels == label).tolist() for label in np.unique(labels)]
    return sorted(groups, key=lambda group: group[0])


def least_of(spearman: Array, group: Sequence[int]) -> float:
    """Return the smallest absolute rank correlation of two members."""
    part = np.abs(spearman[np.ix_(group, group)])
    return float(part.min())
