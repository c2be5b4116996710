"""ROS 2: a package around the C code."""

from edp.export.ros2.target import Ros2Target

__all__ = ["Ros2Target"]
