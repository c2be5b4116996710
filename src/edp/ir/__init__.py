"""A network as a plain list of streaming layers, each one tick at a time: what export targets and quantisation read."""

from edp.ir.base import Array, Graph, Layer, Slot
from edp.ir.builder import Builder

__all__ = ["Array", "Builder", "Graph", "Layer", "Slot"]
