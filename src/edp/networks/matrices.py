"""Weight matrices of the multiply-accumulates in a network, the subject of compression, adapters and probes."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from edp.networks.cells import Stack
from edp.networks.streaming import Streaming

Declared = tuple[tuple[str, tuple[int, ...]], ...]
LAYERS: dict[type[nn.Module], Declared] = {
    nn.Linear: (("weight", (0,)),),
    nn.LSTM: (("weight_ih_l0", (0,)), ("weight_hh_l0", (0,))),
}


@dataclass(frozen=True, eq=False)
class Matrix:
    """A weight of multiply-accumulates.

    Attributes:
        name: name in the network.
        part: the module that is called with it.
        holder: the module that it is a parameter of, under `key`.
        axes: axes of its outputs.
    """

    name: str
    part: nn.Module
    holder: nn.Module
    key: str
    axes: tuple[int, ...]

    @property
    def values(self) -> Tensor:
        """The parameter."""
        return self.holder.get_parameter(self.key)


def matrices_of(network: nn.Module, recurrent: bool = True) -> list[Matrix]:
    """Return the weights of the convolutions, recurrent layers, linear layers and heads of a network.

    Args:
        network: network whose parts list the parameters of their multiplications (`Streaming.matrices`).
        recurrent: whether to include the weights of recurrent layers.
    """
    stacks = [stack for stack in network.modules() if isinstance(stack, Stack)]
    recurring = {part for stack in stacks for layer in stack.layers for part in layer.modules()}
    matrices = []
    for name, part in network.named_modules():
        if part not in recurring or recurrent:
            for key, axes in _find_matrices(part):
                parameter = getattr(part, key)
                listed = isinstance(parameter, nn.ParameterList)
                for last in map(str, range(len(parameter))) if listed else [key]:
                    full = ".".join(filter(None, (name, key if listed else "", last)))
                    matrices.append(Matrix(full, part, parameter if listed else part, last, axes))
    return matrices


def _find_matrices(part: nn.Module) -> Declared:
    declared = next((matrices for kind, matrices in LAYERS.items() if isinstance(part, kind)), ())
    return declared or (part.matrices if isinstance(part, Streaming) else ())
