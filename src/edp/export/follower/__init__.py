"""Grey box with on-board adaptation of its parameters, as C99 without heap."""

from edp.export.follower.parts import FollowerParts as FollowerParts
from edp.export.follower.parts import GoldenTicks as GoldenTicks
from edp.export.follower.write import write_follower as write_follower

__all__ = ["FollowerParts", "GoldenTicks", "write_follower"]
