"""Backbone and head of a network, by the names of its parameters (thesis 3.4.3)."""

from __future__ import annotations

from dataclasses import dataclass

from edp.networks.predictor import Predictor

BACKBONE = "backbone"


@dataclass(frozen=True)
class Decomposition:
    """Assignment of the parameters to the parts of a network.

    Attributes:
        backbone: names of parameters by part of the backbone, from the input on; parts are the beginnings of names.
        head: names of all other parameters: gate, heads, output, activation, skip connection and trained physics
            parameters.
        last: parameters of `head` that belong to the last linear layer of the heads.
    """

    backbone: dict[str, tuple[str, ...]]
    head: tuple[str, ...]
    last: tuple[str, ...]

    @property
    def encoding(self) -> tuple[str, ...]:
        """Names of all parameters of the backbone."""
        return tuple(name for names in self.backbone.values() for name in names)


def decompose(predictor: Predictor) -> Decomposition:
    """Return the parts declared by the backbone (`BackboneSpec.parts`); parts without parameters are omitted."""
    names = [name for name, _ in predictor.named_parameters()]
    parts = [f"{BACKBONE}.{part}" for part in predictor.spec.backbone.parts()] or [BACKBONE]
    names_by_part = {part: tuple(name for name in names if name.startswith(f"{part}.")) for part in parts}
    inside = {name for some in names_by_part.values() for name in some}
    depth = len(predictor.heads.weights) - 1
    last = (f"heads.weights.{depth}", f"heads.biases.{depth}")
    return Decomposition(
        {part: some for part, some in names_by_part.items() if some},
        tuple(name for name in names if name not in inside),
        tuple(name for name in names if name in last),
    )
