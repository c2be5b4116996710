"""Coverage targets for learning a model of a machine, and their check."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from edp.data.coverage import Coverage
from edp.data.spectrum import FLAT_DB
from edp.wording import typed

OCCUPANCY = 0.9
"""Target for the fraction of visited stroke cells."""
BEYOND = 0.1
"""Maximum fraction of test samples farther from the training data than 95 % of the training samples. The fraction is 5
% for equally distributed data."""


@dataclass(frozen=True)
class CoverageTarget:
    """One coverage figure and its target.

    Attributes:
        name: name of the figure.
        value: the figure.
        bound: least or most that is wanted.
        at_least: whether the bound is the least; else the most.
        unit: unit of value and target; fractions are in %.
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

    def to_json(self) -> dict[str, object]:
        """Return the plain values."""
        return {**asdict(self), "met": self.met}


def wanted(coverage: Coverage) -> tuple[CoverageTarget, ...]:
    """Return all coverage figures that can be computed from the data, each with its target."""
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
