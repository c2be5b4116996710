"""What a data set should cover to learn a model of a machine from, and whether it does."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

from edp.data.coverage import Coverage
from edp.data.spectrum import FLAT_DB
from edp.wording import typed

OCCUPANCY = 0.9
"""Share of the cells of the strokes that should be visited."""
BEYOND = 0.1
"""Share of the tests that may lie beyond 95 % of the training; 5 % where both are alike."""


@dataclass(frozen=True)
class CoverageTarget:
    """One figure of the coverage against what is wanted of it.

    Attributes:
        name: what.
        value: the figure.
        bound: least or most that is wanted.
        at_least: whether the bound is the least; else the most.
        unit: of both; shares are in %.
    """

    name: str
    value: float
    bound: float
    at_least: bool
    unit: str

    @property
    def met(self) -> bool:
        """Whether the figure keeps the bound."""
        return self.value >= self.bound if self.at_least else self.value <= self.bound

    def to_json(self) -> dict[str, Any]:
        """Plain values."""
        return {**asdict(self), "met": self.met}


def wanted(coverage: Coverage) -> tuple[CoverageTarget, ...]:
    """Every figure that the data allow to judge, by what is wanted of it."""
    targets = []
    if coverage.occupancy is not None:
        targets.append(
            CoverageTarget("cells of the strokes visited", 100 * coverage.occupancy.share, 100 * OCCUPANCY, True, "%")
        )
    inputs = coverage.spectrum
    if inputs is not None and len(inputs.frequency_hz):
        targets += [
            CoverageTarget(f"{name}: within {typed(FLAT_DB)} dB up to", flat, inputs.used_hz, True, "Hz")
            for name, flat in zip(inputs.names, inputs.flat_to_hz, strict=True)
        ]
    if coverage.distance is not None:
        share = 100 * coverage.distance.beyond
        targets.append(CoverageTarget("tests farther than 95 % of the training", share, 100 * BEYOND, False, "%"))
    return tuple(targets)
