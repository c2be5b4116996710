"""The ROS 2 node of a monitor: messages in, diagnostics out; what they mean is in core.py and watch.py."""

from __future__ import annotations

from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import FluidPressure, JointState
from std_msgs.msg import Bool

from .core import Assembler, Tick, read_sources
from .watch import ERROR, OK, STALE, WARN, MonitorCore, MonitorReport

LEVELS = {OK: "OK", WARN: "WARN", ERROR: "ERROR", STALE: "STALE"}


def seconds(stamp: Any) -> float:
    """A time of ROS in seconds."""
    return float(stamp.sec + 1e-9 * stamp.nanosec)


class MonitorNode(Node):
    """Watches at each message of joints; see README.md for topics and parameters."""

    def __init__(self) -> None:
        super().__init__("monitor")
        core = MonitorCore()
        self.declare_parameter("sources", [""])
        self.declare_parameter("rate_hz", float(core.about["rate_hz"]))
        rate = self.get_parameter("rate_hz").value
        if rate != core.about["rate_hz"]:
            raise ValueError(f"rate_hz is {rate}; the monitor has {core.about['rate_hz']} Hz, leave it out")
        self.ticks = Assembler(core, read_sources(core.inputs, list(self.get_parameter("sources").value)))
        self.watch = MonitorReport(core)
        self.alarm = self.create_publisher(Bool, "~/alarm", qos_profile=10)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos_profile=10)
        self.create_subscription(JointState, "joint_states", self.on_joints, qos_profile_sensor_data)
        self.create_subscription(FluidPressure, "pressures", self.on_pressure, qos_profile_sensor_data)
        self.create_timer(1.0, self.report)
        self.last: Tick | None = None
        self.stamp = 0.0
        self.fresh = False

    def on_pressure(self, message: Any) -> None:
        """A pressure; its frame_id names the sensor."""
        self.ticks.pressure(message.header.frame_id, message.fluid_pressure, seconds(message.header.stamp))

    def on_joints(self, message: Any) -> None:
        """A tick; an alarm is reported at once."""
        position, velocity, effort = (list(part) for part in (message.position, message.velocity, message.effort))
        self.stamp = seconds(message.header.stamp)
        self.last = self.ticks.joints(list(message.name), position, velocity, effort, self.stamp)
        self.fresh = True
        if self.watch.take(self.last, self.stamp):
            self.get_logger().warning("alarm")
            self.report()

    def report(self) -> None:
        """Once a second, and at every alarm."""
        level, text, values = self.watch.report(self.last, self.stamp, self.fresh)
        self.alarm.publish(Bool(data=level == ERROR))
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        entries = [KeyValue(key=key, value=value) for key, value in values.items()]
        levels = getattr(DiagnosticStatus, LEVELS[level])
        message.status = [DiagnosticStatus(level=levels, name=self.get_name(), message=text, values=entries)]
        self.diagnostics.publish(message)
        self.fresh = False


def main(args: Any = None) -> None:
    """Run until interrupted."""
    rclpy.init(args=args)
    node = MonitorNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
