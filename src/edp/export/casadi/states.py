"""State of a network as a column vector: slots in the order of the layers, rings with the oldest sample first."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from edp.export.c.text import identifier
from edp.ir import Array, Graph, memory
from edp.ir.base import Slot


@dataclass(frozen=True, eq=False)
class Place:
    """A slot in the column.

    Attributes:
        layer: layer of the state.
        slot: slot within the layer.
        at: its first number.
    """

    layer: str
    slot: Slot
    at: int

    @property
    def rows(self) -> int:
        """Ticks, or pairs of a rotation; 1 otherwise."""
        return self.slot.shape[0] if len(self.slot.shape) == 2 else 1

    @property
    def columns(self) -> int:
        """Numbers of a row."""
        return self.slot.size // self.rows if self.rows else 0

    @property
    def field(self) -> str:
        """The name in the C state."""
        return f"{identifier(self.layer)}_{self.slot.name}"


def places(graph: Graph) -> list[Place]:
    """Return every slot with elements.

    Ages are integers: samples seen before the present one, up to the relevant maximum.
    """
    states, at = [], 0
    for layer, slot in graph.slots():
        # Empty rings have no place in a column.
        if slot.size:
            # Scores are a ring of one number a tick.
            shape = (slot.size, 1) if slot.name == "scores" else slot.shape
            states.append(Place(layer, Slot(slot.name, shape, slot.fill), at))
            at += slot.size
    return states


def start(graph: Graph) -> Array:
    """Return the state column after a reset."""
    parts = [graph.start(layer, slot).ravel() for layer, slot in graph.slots() if slot.size]
    return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def is_ring(graph: Graph, state: Place) -> bool:
    """Return whether the rows are ticks that the C code keeps as a ring."""
    return state.slot.name in ("ring", "keys", "values", "scores")


def counts(graph: Graph, state: Place) -> bool:
    """Return whether the ring of the C code knows how many ticks it has seen.

    A convolution takes all of them as seen.
    """
    return not isinstance(graph.layer(state.layer), memory.Convolution)
