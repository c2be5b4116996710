"""Physics bases: one file each, entered in `PHYSICS` by name."""

from edp.models.physics.base import PHYSICS, PhysicsBase, PhysicsSpec
from edp.models.physics.force import ForceSpec
from edp.models.physics.hybrid import HybridPhysicsSpec
from edp.models.physics.kinematic import KinematicSpec

__all__ = ["PHYSICS", "ForceSpec", "HybridPhysicsSpec", "KinematicSpec", "PhysicsBase", "PhysicsSpec"]
