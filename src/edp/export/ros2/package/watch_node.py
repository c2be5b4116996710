"""ROS 2 node of a monitor: messages in, diagnostics out; their meaning is defined in core.py and watch.py."""

from __future__ import annotations

from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from std_msgs.msg import Bool

from .tick_node import TickNode, run, seconds
from .watch import ERROR, OK, STALE, WARN, MonitorCore, MonitorReport

LEVELS = {OK: "OK", WARN: "WARN", ERROR: "ERROR", STALE: "STALE"}


class MonitorNode(TickNode):
    """Watches at each message of joints; see README.md for topics and parameters."""

    def __init__(self) -> None:
        core = MonitorCore()
        super().__init__("monitor", core)
        self.watch = MonitorReport(core)
        self.alarm = self.create_publisher(Bool, "~/alarm", qos_profile=10)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos_profile=10)
        self.stamp = 0.0
        self.listen()

    def on_joints(self, message: Any) -> None:
        """Process one sample; an alarm is reported immediately."""
        self.stamp = seconds(message.header.stamp)
        self.last = self.tick_of(message)
        if self.watch.take(self.last, self.stamp):
            self.get_logger().warning("alarm")
            self.report()

    def report(self) -> None:
        """Report once a second, and at every alarm."""
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
    run(MonitorNode, args)
