"""C99 for controllers: a fixed runtime, and a generated model that is data and a list of calls."""

from edp.export.c.target import CTarget

__all__ = ["CTarget"]
