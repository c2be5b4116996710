"""ROS 2 node for messages; their meaning is defined in core.py."""

from __future__ import annotations

from functools import partial
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64

from .core import Core
from .tick_node import TickNode, run

FIELDS = {"velocity": "velocity", "angular_velocity": "velocity", "position": "position", "angle": "position"}
"""Field of a JointState message by kind of target. Other kinds use the field effort."""


class PredictorNode(TickNode):
    """Predicts at each message of joints; see README.md for topics and parameters."""

    def __init__(self) -> None:
        core = Core()
        super().__init__("predictor", core)
        make = partial(self.create_publisher, qos_profile=10)
        self.results = {
            (meaning, number, ahead["ticks"]): make(JointState, f"~/{meaning}{number or ''}/ahead_{ahead['ticks']}")
            for meaning in core.results
            for number in range(len(core.result(meaning)))
            for ahead in core.about["horizons"]
        }
        self.valid, self.step_us = make(Bool, "~/valid"), make(Float64, "~/step_us")
        self.diagnostics = make(DiagnosticArray, "/diagnostics")
        self.listen()

    def on_joints(self, message: Any) -> None:
        """Process one sample."""
        tick = self.tick_of(message)
        if self.last is None or (tick.why and tick.why != self.last.why):
            self.get_logger().warning(tick.why or "predicting")
        self.last = tick
        self.valid.publish(Bool(data=tick.valid))
        self.step_us.publish(Float64(data=tick.step_us))
        if tick.predicted:
            self.publish(message.header.stamp)

    def publish(self, stamp: Any) -> None:
        """Publish the results of this sample with the time stamp of its inputs."""
        core = self.ticks.core
        for meaning in core.results:
            for number, interval in enumerate(core.result(meaning)):
                for ahead, values in zip(core.about["horizons"], interval):
                    message = JointState()
                    message.header.stamp = stamp
                    message.name = [target["name"] for target in core.about["targets"]]
                    for field in ("position", "velocity", "effort"):
                        kinds = [FIELDS.get(target["kind"], "effort") for target in core.about["targets"]]
                        if field in kinds:
                            # One that goes elsewhere is NaN here: a JointState has all of a field or none.
                            nan = float("nan")
                            setattr(message, field, [v if k == field else nan for v, k in zip(values, kinds)])
                    self.results[meaning, number, ahead["ticks"]].publish(message)

    def report(self) -> None:
        """Report once a second; without joint messages since the last report, the prediction is invalid."""
        tick, core = self.last, self.ticks.core
        if not self.fresh:
            self.valid.publish(Bool(data=False))
        good = self.fresh and tick is not None and tick.valid
        why = "predicting" if good else tick.why if self.fresh and tick is not None else "no joints in the last second"
        counts = core.counts | {"messages_rejected": self.ticks.rejected}
        values = [KeyValue(key=key, value=str(value)) for key, value in counts.items()]
        values += [KeyValue(key="step_us", value=f"{tick.step_us:.1f}" if tick is not None else "")]
        values += [KeyValue(key="model_hash", value=core.about["model_hash"])]
        level = DiagnosticStatus.OK if good else DiagnosticStatus.WARN
        message = DiagnosticArray()
        message.header.stamp = self.get_clock().now().to_msg()
        message.status = [DiagnosticStatus(level=level, name=self.get_name(), message=why, values=values)]
        self.diagnostics.publish(message)
        self.fresh = False


def main(args: Any = None) -> None:
    """Run until interrupted."""
    run(PredictorNode, args)
