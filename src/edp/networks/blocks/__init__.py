"""Optional structural modules: one file each, entered in `BLOCKS` by name."""

from edp.networks.blocks.attention_bridge import AttentionBridge
from edp.networks.blocks.base import BLOCKS, BlockSlot, BlockSpec
from edp.networks.blocks.cross_cylinder_attention import CrossCylinderAttention
from edp.networks.blocks.cylinder_gate import CylinderGate
from edp.networks.blocks.global_average_pooling import GlobalAveragePooling
from edp.networks.blocks.linear_bypass import LinearBypass
from edp.networks.blocks.multi_scale_tcn import MultiScaleTcn
from edp.networks.blocks.squeeze_excitation import SqueezeExcitation
from edp.networks.blocks.temporal_difference import TemporalDifference
from edp.networks.blocks.velocity_skip import VelocitySkip

__all__ = [
    "BLOCKS",
    "AttentionBridge",
    "BlockSlot",
    "BlockSpec",
    "CrossCylinderAttention",
    "CylinderGate",
    "GlobalAveragePooling",
    "LinearBypass",
    "MultiScaleTcn",
    "SqueezeExcitation",
    "TemporalDifference",
    "VelocitySkip",
]
