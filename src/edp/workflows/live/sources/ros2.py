"""``--ros2``: joints and pressures of a running ROS 2 with rclpy; topics equal the topics of exported nodes."""

from __future__ import annotations

import importlib
from typing import Any, ClassVar

import numpy as np

from edp.errors import ConfigError, DataError, brief
from edp.signals import VOCABULARY, Channel, Kind
from edp.workflows.live.sources.arrivals import Arrivals
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Row, Sink, SourceOptions, choose_rate

JOINTS, PRESSURES = "joint_states", "pressures"
"""Topics: sensor_msgs/JointState, whose names are channels, and sensor_msgs/FluidPressure, whose frame_id is one."""
FIELDS = {
    Kind.VELOCITY: "velocity",
    Kind.ANGULAR_VELOCITY: "velocity",
    Kind.POSITION: "position",
    Kind.ANGLE: "position",
}
"""Field of a JointState by kind of channel; any other kind is an effort."""
SPIN_S = 0.1
MAX_JOINTS = 4096
"""Joints of one message."""


@SOURCES.register("ros2")
class Ros2Source(LiveSource):
    """A row at each message of joints, with the pressures that came last.

    Args:
        channels: channels to take, by name.
        rate_hz: rate of the joint messages.
        joints: topic of the joints; `pressures` likewise.
        pressures: see `joints`.

    Raises:
        ConfigError: there is no ROS 2 here.
    """

    steered: ClassVar[bool] = False
    options: ClassVar[frozenset[str]] = frozenset({"rate", "machine", "until-end"})
    ending = "the node has ended"

    def __init__(
        self, channels: tuple[Channel, ...], rate_hz: float, joints: str = JOINTS, pressures: str = PRESSURES
    ) -> None:
        self._ros, messages, qos = _ros2()
        self.channels, self.rate_hz = channels, rate_hz
        self.text = f"ROS 2, {joints} and {pressures}"
        self._names = frozenset(channel.name for channel in channels)
        self._pressures: dict[str, float] = {}
        self._messages: list[Any] = []
        self._ros.init(args=[])
        self._node = self._ros.create_node("edp_live")
        profile = qos.qos_profile_sensor_data
        self._node.create_subscription(messages.JointState, joints, self._on_joints, profile)
        self._node.create_subscription(messages.FluidPressure, pressures, self._on_pressure, profile)

    @classmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> Ros2Source:
        """Create a source with the channels of the models; without a model, with the channels of Table A.1."""
        channels = tuple(needs.channels) or tuple(VOCABULARY.values())[:24]
        source = cls(channels, choose_rate(options, needs, "--ros2"))
        source.machine = options.machine
        return source

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        arrivals = Arrivals(sink, self.rate_hz)
        while not sink.stopped:
            self._ros.spin_once(self._node, timeout_sec=SPIN_S)
            messages, self._messages = self._messages, []
            if not messages:
                arrivals.wait()
            for message in messages:
                try:
                    seconds, row = self._row(message)
                except (DataError, TypeError, ValueError, OverflowError, AttributeError) as error:
                    sink.leave_out(brief(error))
                else:
                    arrivals.take(row, seconds)

    def close(self) -> None:
        """See `LiveSource`."""
        self._node.destroy_node()
        self._ros.try_shutdown()

    def _on_pressure(self, message: Any) -> None:
        name = str(message.header.frame_id)
        # Senders may invent as many names as they like.
        if name in self._names:
            self._pressures[name] = message.fluid_pressure

    def _on_joints(self, message: Any) -> None:
        self._messages.append(message)

    def _row(self, message: Any) -> tuple[float, Row]:
        """Time stamp (s) and values of a message of joints, with the pressures that came last."""
        if len(message.name) > MAX_JOINTS:
            raise DataError(f"it names {len(message.name):,} joints; at most {MAX_JOINTS} are expected")
        at = {str(name): n for n, name in reversed(list(enumerate(message.name)))}
        row = np.full(len(self.channels), np.nan)
        for column, channel in enumerate(self.channels):
            values = getattr(message, FIELDS.get(channel.kind, "effort"))
            if at.get(channel.name, len(values)) < len(values):
                row[column] = float(values[at[channel.name]])
            elif channel.name in self._pressures:
                row[column] = float(self._pressures[channel.name])
        stamp = message.header.stamp
        return float(stamp.sec + 1e-9 * stamp.nanosec), row


def _ros2() -> tuple[Any, Any, Any]:
    try:
        return tuple(map(importlib.import_module, ("rclpy", "sensor_msgs.msg", "rclpy.qos")))  # type: ignore[return-value]
    except ImportError as error:
        raise ConfigError(
            f"--ros2 needs ROS 2 with rclpy and sensor_msgs, and {error.name} is not here; source its setup.bash first "
            "and start edp with its Python, or send rows by --udp"
        ) from error
