"""Optional structural modules: one file each, entered in `BLOCKS` by name."""

from edp.networks.blocks.attention_bridge import AttentionBridge as AttentionBridge
from edp.networks.blocks.base import BLOCKS, BlockSlot, BlockSpec
from edp.networks.blocks.cross_cylinder_attention import CrossCylinderAttention as CrossCylinderAttention
from edp.networks.blocks.cylinder_gate import CylinderGate as CylinderGate
from edp.networks.blocks.global_average_pooling import GlobalAveragePooling as GlobalAveragePooling
from edp.networks.blocks.linear_bypass import LinearBypass as LinearBypass
from edp.networks.blocks.machine_code import MachineCode as MachineCode
from edp.networks.blocks.multi_scale_tcn import MultiScaleTcn as MultiScaleTcn
from edp.networks.blocks.squeeze_excitation import SqueezeExcitation as SqueezeExcitation
from edp.networks.blocks.temporal_difference import TemporalDifference as TemporalDifference
from edp.networks.blocks.velocity_skip import VelocitySkip as VelocitySkip

__all__ = [
    "BLOCKS",
    "BlockSlot",
    "BlockSpec",
]
