"""``--ros2``: joints and pressures of a running ROS 2, where rclpy is installed; topics as those of exported nodes."""

from __future__ import annotations

import importlib
import math
import time
from typing import Any, ClassVar

import numpy as np

from edp.errors import ConfigError
from edp.signals import VOCABULARY, Channel, Kind
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Row, Sink, SourceOptions, chosen_rate
from edp.workflows.live.sources.udp import SILENT_S, RowClock

JOINTS, PRESSURES = "joint_states", "pressures"
"""Topics: sensor_msgs/JointState, whose names are channels, and sensor_msgs/FluidPressure, whose frame_id is one."""
FIELDS = {
    Kind.VELOCITY: "velocity",
    Kind.ANGULAR_VELOCITY: "velocity",
    Kind.POSITION: "position",
    Kind.ANGLE: "position",
}
"""Where a channel of a kind stands in a JointState; any other is an effort."""
SPIN_S = 0.1


@SOURCES.register("ros2")
class Ros2Source(LiveSource):
    """A row at each message of joints, with the pressures that came last.

    Args:
        channels: that are taken, by their names.
        rate_hz: of the messages of joints.
        joints: topic of the joints; `pressures` likewise.
        pressures: see `joints`.

    Raises:
        ConfigError: there is no ROS 2 here.
    """

    steered: ClassVar[bool] = False
    ending = "the node has ended"

    def __init__(
        self, channels: tuple[Channel, ...], rate_hz: float, joints: str = JOINTS, pressures: str = PRESSURES
    ) -> None:
        self._ros, messages, qos = _ros2()
        self.channels, self.rate_hz = channels, rate_hz
        self.text = f"ROS 2, {joints} and {pressures}"
        self._pressures: dict[str, float] = {}
        self._rows: list[tuple[float, Row]] = []
        self._ros.init(args=[])
        self._node = self._ros.create_node("edp_live")
        profile = qos.qos_profile_sensor_data
        self._node.create_subscription(messages.JointState, joints, self._on_joints, profile)
        self._node.create_subscription(messages.FluidPressure, pressures, self._on_pressure, profile)

    @classmethod
    def of(cls, options: SourceOptions, needs: Needs) -> Ros2Source:
        """Channels are those of the models; without a model those of Table A.1."""
        channels = tuple(needs.channels) or tuple(VOCABULARY.values())[:24]
        source = cls(channels, chosen_rate(options, needs, "--ros2"))
        source.machine = options.machine
        return source

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        clock, heard, silent, trusted = RowClock(self.rate_hz), time.monotonic(), False, True
        while not sink.stopped:
            self._ros.spin_once(self._node, timeout_sec=SPIN_S)
            rows, self._rows = self._rows, []
            if not rows and not silent and time.monotonic() - heard > SILENT_S:
                silent = True
                sink.note(
                    "warning", f"no joints for {SILENT_S:g} s: nothing is predicted until they come again", "silent"
                )
            for seconds, row in rows:
                heard, silent = time.monotonic(), False
                missed, back = clock.tick(seconds)
                if back:
                    sink.begin_anew()
                if clock.trusted != trusted:
                    trusted = clock.trusted
                    sink.note(
                        "warning",
                        f"joints come at {clock.measured_hz or math.nan:.4g} Hz; {self.rate_hz:g} Hz are right",
                        "rate",
                    )
                    sink.begin_anew()
                sink.take(row, missed, trusted)

    def close(self) -> None:
        """See `LiveSource`."""
        self._node.destroy_node()
        self._ros.try_shutdown()

    def _on_pressure(self, message: Any) -> None:
        self._pressures[str(message.header.frame_id)] = float(message.fluid_pressure)

    def _on_joints(self, message: Any) -> None:
        names = [str(name) for name in message.name]
        row = np.full(len(self.channels), np.nan, np.float32)
        for column, channel in enumerate(self.channels):
            values = getattr(message, FIELDS.get(channel.kind, "effort"))
            if channel.name in names and names.index(channel.name) < len(values):
                row[column] = values[names.index(channel.name)]
            elif channel.name in self._pressures:
                row[column] = self._pressures[channel.name]
        stamp = message.header.stamp
        self._rows.append((float(stamp.sec + 1e-9 * stamp.nanosec), row))


def _ros2() -> tuple[Any, Any, Any]:
    try:
        return tuple(map(importlib.import_module, ("rclpy", "sensor_msgs.msg", "rclpy.qos")))  # type: ignore[return-value]
    except ImportError as error:
        raise ConfigError(
            f"--ros2 needs ROS 2 with rclpy and sensor_msgs, and {error.name} is not here; source its setup.bash first "
            "and start edp with its Python, or send rows by --udp"
        ) from error
