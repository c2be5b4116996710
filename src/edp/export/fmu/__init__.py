"""FMI 2.0 and 3.0 for co-simulation: the C core behind a fixed plumbing, and files that describe it."""

from edp.export.fmu.target import FmuTarget

__all__ = ["FmuTarget"]
