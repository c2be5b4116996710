"""Physics bases: one file each, entered in `PHYSICS` by name."""

from edp.networks.physics.base import PHYSICS, PhysicsBase, PhysicsSpec
from edp.networks.physics.force import ForceSpec
from edp.networks.physics.hybrid import HybridPhysicsSpec
from edp.networks.physics.kinematic import KinematicSpec

__all__ = ["PHYSICS", "ForceSpec", "HybridPhysicsSpec", "KinematicSpec", "PhysicsBase", "PhysicsSpec"]
