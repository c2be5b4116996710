"""Predicts from a recorded bag (MCAP or SQLite) without ROS, by `pip install rosbags`.

python -m PACKAGE.replay BAG params.yaml > predictions.csv
"""

from __future__ import annotations

import csv
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TextIO

from .core import Assembler, Core, Tick, read_sources

TYPES = {"sensor_msgs/msg/JointState": "joints", "sensor_msgs/msg/FluidPressure": "pressure"}


def sources_of(path: Path) -> list[str]:
    """Return the parameter `sources` of a parameter file.

    Raises:
        ValueError: it has none.
    """
    import yaml  # comes with ROS and with rosbags

    for node in (yaml.safe_load(path.read_text()) or {}).values():
        sources = node.get("ros__parameters", {}).get("sources") if isinstance(node, dict) else None
        if sources:
            return list(sources)
    raise ValueError(f"{path} has no ros__parameters with sources")


def replay(bag: Path, ticks: Assembler, joints: str = "/joint_states", pressures: str = "/pressures") -> Iterator[Any]:
    """Process the messages of a bag in recorded order; yields time and `Tick`."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        connections = [c for c in reader.connections if c.topic in (joints, pressures) and c.msgtype in TYPES]
        for connection, _, raw in reader.messages(connections=connections):
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            if TYPES[connection.msgtype] == "pressure":
                ticks.pressure(message.header.frame_id, message.fluid_pressure, stamp)
                continue
            parts = (message.position, message.velocity, message.effort)
            position, velocity, effort = ([float(value) for value in part] for part in parts)
            yield stamp, ticks.joints(list(message.name), position, velocity, effort, stamp)


def write(bag: Path, ticks: Assembler, to: TextIO) -> int:
    """Write the predictions of a bag as CSV, one row per joint message, and return the number of valid rows."""
    about, table, valid = ticks.core.about, csv.writer(to), 0
    heads = [f"{target['name']}+{ahead['ticks']}" for ahead in about["horizons"] for target in about["targets"]]
    table.writerow(["time_s", "valid", "status", "why", *heads])
    for stamp, tick in replay(bag, ticks):
        valid += tick.valid
        table.writerow(
            [f"{stamp:.9f}", int(tick.valid), _name(tick), tick.why, *_numbers(ticks.core, tick, len(heads))]
        )
    return valid


def _name(tick: Tick) -> str:
    return "none" if tick.status is None else tick.status.name.lower()


def _numbers(core: Core, tick: Tick, wide: int) -> list[str]:
    if not tick.predicted:
        return [""] * wide
    return [f"{value:.9g}" for row in core.result()[0] for value in row]


def main() -> None:
    """See the head of this file."""
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    core = Core()
    ticks = Assembler(core, read_sources(core.inputs, sources_of(Path(sys.argv[2]))))
    valid = write(Path(sys.argv[1]), ticks, sys.stdout)
    print(f"{valid} valid predictions", file=sys.stderr)


if __name__ == "__main__":
    main()
