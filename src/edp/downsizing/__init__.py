"""Smaller networks from a run: one student, or a search for the best that a controller can run."""

from edp.compress.judged import Found, Judged
from edp.downsizing.distil import DistilSpec, distil
from edp.downsizing.searching import SearchSpec, Watchers, search

__all__ = ["DistilSpec", "Found", "Judged", "SearchSpec", "Watchers", "distil", "search"]
