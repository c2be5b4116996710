"""Recurrent layers: one file each, entered in `CELLS` by name."""

from edp.models.cells.base import CELLS, CellSpec, Stack
from edp.models.cells.diagonal_ssm import DiagonalSsmCell
from edp.models.cells.gru import GruCell
from edp.models.cells.layer_norm_lstm import LayerNormLstmCell
from edp.models.cells.lstm import LstmCell
from edp.models.cells.min_gru import MinGruCell

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
