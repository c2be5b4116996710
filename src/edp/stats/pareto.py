"""Pareto front: points that no other point dominates, for several objectives to be minimised."""

from __future__ import annotations

from collections.abc import Sequence


def pareto(points: Sequence[Sequence[float]]) -> list[int]:
    """Return places of the points that no other one betters in one value without being worse in another, in order."""
    optimal = []
    for index, point in enumerate(points):
        better = (
            all(a <= b for a, b in zip(other, point, strict=True))
            and any(a < b for a, b in zip(other, point, strict=True))
            for other in points
        )
        if not any(better):
            optimal.append(index)
    return optimal
