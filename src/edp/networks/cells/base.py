"""Recurrent layers: registry, interface and stacking."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

from torch import Tensor, nn

from edp.errors import ConfigError
from edp.ir import Builder
from edp.networks.streaming import Cost, State, Streaming
from edp.registry import Registry
from edp.settings.bounds import below, shown


class CellSpec(Protocol):
    """Options of a recurrent layer.

    Attributes:
        family: ``lstm`` or ``gru`` where the thesis's backbone of that name may have it, else its own.
        zoneout: whether zoneout (thesis 3.2.4.1) is defined for it.
    """

    family: ClassVar[str]
    zoneout: ClassVar[bool]

    def build(self, width_in: int, units: int, zoneout: float) -> Streaming:
        """Return one layer, ``(batch, time, width_in)`` to ``(batch, time, units)``; its state is zero at reset."""
        ...


CELLS: Registry[type[CellSpec]] = Registry("recurrent layer")


def check_cell(backbone: str, cell: CellSpec, zoneout: float, families: Sequence[str] = ()) -> None:
    """Raise ConfigError for a layer that does not fit the backbone, or for zoneout on a layer without it.

    Raises:
        ConfigError: the layer does not fit; the message states the reason.
    """
    kind = CELLS.name_of(cell)
    if families and cell.family not in families:
        raise ConfigError(
            f"backbone '{backbone}' with cell '{kind}': it has layers of the family {' or '.join(families)}, and "
            f"'{kind}' is of the family {cell.family}; take a cell of its family, or the backbone 'hybrid', which "
            "has any of them"
        )
    if not below(0.0, 1.0).holds(zoneout):
        raise ConfigError(f"backbone '{backbone}': zoneout = {shown(zoneout)}; 0 <= zoneout < 1 must hold")
    if zoneout and not cell.zoneout:
        supporting = ", ".join(name for name in CELLS if CELLS[name].zoneout)
        raise ConfigError(
            f"backbone '{backbone}': zoneout = {zoneout} with cell '{kind}', but zoneout keeps the h and c of an LSTM "
            f"(thesis 3.2.4.1); set zoneout = 0, or take one of the cells {supporting}"
        )


class Stack(Streaming):
    """Recurrent layers one above the other, with dropout between them in training."""

    def __init__(
        self, cell: CellSpec, width_in: int, units: int, layers: int, dropout: float, zoneout: float = 0.0
    ) -> None:
        super().__init__()
        widths = [width_in] + [units] * (layers - 1)
        self.layers = nn.ModuleList(cell.build(width, units, zoneout) for width in widths)
        self.dropout = nn.Dropout(dropout)

    def _layers(self) -> list[Streaming]:
        return [layer for layer in self.layers if isinstance(layer, Streaming)]

    def initial_state(self, batch: int, like: Tensor) -> State:
        return tuple(layer.initial_state(batch, like) for layer in self._layers())

    def forward(self, x: Tensor, state: State) -> tuple[Tensor, State]:
        new = []
        for number, (layer, old) in enumerate(zip(self._layers(), state, strict=True)):
            x, layer_state = layer(self.dropout(x) if number else x, old)
            new.append(layer_state)
        return x, tuple(new)

    def lower(self, build: Builder, x: str) -> str:
        for number, layer in enumerate(self._layers(), start=1):
            with build.inside(f"recurrent{number}"):
                x = layer.lower(build, x)
        return x

    def costs(self) -> list[Cost]:
        return [cost for layer in self._layers() for cost in layer.costs()]
