"""Common base of the nodes of this package: samples from joint and pressure messages."""

from __future__ import annotations

from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import FluidPressure, JointState

from .core import Assembler, Tick, read_sources


def seconds(stamp: Any) -> float:
    """Convert a ROS time to seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


class TickNode(Node):
    """A node that assembles a tick at each message of joints; see README.md for topics and parameters.

    Args:
        name: name of the node.
        core: receiver of each sample.

    Raises:
        ValueError: the parameter `rate_hz` is another rate than that of the core.
    """

    def __init__(self, name: str, core: Any) -> None:
        super().__init__(name)
        self.declare_parameter("sources", [""])
        self.declare_parameter("rate_hz", float(core.about["rate_hz"]))
        rate = self.get_parameter("rate_hz").value
        if rate != core.about["rate_hz"]:
            raise ValueError(f"rate_hz is {rate}; the network was trained at {core.about['rate_hz']} Hz, leave it out")
        self.ticks = Assembler(core, read_sources(core.inputs, list(self.get_parameter("sources").value)))
        self.last: Tick | None = None
        self.fresh = False

    def listen(self) -> None:
        """Subscribe once that which is published can be: a message may come at once."""
        self.create_subscription(JointState, "joint_states", self.on_joints, qos_profile_sensor_data)
        self.create_subscription(FluidPressure, "pressures", self.on_pressure, qos_profile_sensor_data)
        self.create_timer(1.0, self.report)

    def on_pressure(self, message: Any) -> None:
        """Store a pressure; its frame_id names the sensor."""
        self.ticks.pressure(message.header.frame_id, message.fluid_pressure, seconds(message.header.stamp))

    def tick_of(self, message: Any) -> Tick:
        """Return the sample of a joint message."""
        position, velocity, effort = (list(part) for part in (message.position, message.velocity, message.effort))
        self.fresh = True
        return self.ticks.joints(list(message.name), position, velocity, effort, seconds(message.header.stamp))

    def on_joints(self, message: Any) -> None:
        """Process one sample."""
        raise NotImplementedError

    def report(self) -> None:
        """Report once a second."""
        raise NotImplementedError


def run(node_class: Any, args: Any = None) -> None:
    """Run a node until interrupted."""
    rclpy.init(args=args)
    node = node_class()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
