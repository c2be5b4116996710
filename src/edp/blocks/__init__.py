"""Optional structural modules: one file each, entered in `BLOCKS` by name."""

from edp.blocks.base import BLOCKS, BlockSpec, Slot
from edp.blocks.cylinder_gate import CylinderGate
from edp.blocks.linear_bypass import LinearBypass
from edp.blocks.multi_scale_tcn import MultiScaleTcn
from edp.blocks.temporal_difference import TemporalDifference

__all__ = ["BLOCKS", "BlockSpec", "CylinderGate", "LinearBypass", "MultiScaleTcn", "Slot", "TemporalDifference"]
