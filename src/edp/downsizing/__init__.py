"""Smaller networks from a run: one student, or a search for the best that a controller can run."""

from edp.downsizing.distil import DistilSpec, distil

__all__ = ["DistilSpec", "distil"]
