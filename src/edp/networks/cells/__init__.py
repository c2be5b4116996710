"""Recurrent layers: one file each, entered in `CELLS` by name."""

from edp.networks.cells.base import CELLS, CellSpec, Stack
from edp.networks.cells.diagonal_ssm import DiagonalSsmCell
from edp.networks.cells.gru import GruCell
from edp.networks.cells.layer_norm_lstm import LayerNormLstmCell
from edp.networks.cells.lstm import LstmCell
from edp.networks.cells.min_gru import MinGruCell

__all__ = [
    "CELLS",
    "CellSpec",
    "DiagonalSsmCell",
    "GruCell",
    "LayerNormLstmCell",
    "LstmCell",
    "MinGruCell",
    "Stack",
]
