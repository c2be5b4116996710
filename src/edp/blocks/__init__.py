"""Optional structural modules: one file each, entered in `BLOCKS` by name."""

from edp.blocks.attention_bridge import AttentionBridge
from edp.blocks.base import BLOCKS, BlockSpec, Slot
from edp.blocks.cross_cylinder_attention import CrossCylinderAttention
from edp.blocks.cylinder_gate import CylinderGate
from edp.blocks.global_average_pooling import GlobalAveragePooling
from edp.blocks.linear_bypass import LinearBypass
from edp.blocks.multi_scale_tcn import MultiScaleTcn
from edp.blocks.squeeze_excitation import SqueezeExcitation
from edp.blocks.temporal_difference import TemporalDifference
from edp.blocks.velocity_skip import VelocitySkip

__all__ = [
    "BLOCKS",
    "AttentionBridge",
    "BlockSpec",
    "CrossCylinderAttention",
    "CylinderGate",
    "GlobalAveragePooling",
    "LinearBypass",
    "MultiScaleTcn",
    "Slot",
    "SqueezeExcitation",
    "TemporalDifference",
    "VelocitySkip",
]
