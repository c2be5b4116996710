"""Network as a plain list of streaming layers, computed sample by sample; input of export and quantisation."""

from edp.ir.base import Array, Graph, Layer, Slot
from edp.ir.builder import Builder

__all__ = ["Array", "Builder", "Graph", "Layer", "Slot"]
