"""Further logs of a machine, read as those were from which its model learned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from edp.errors import EdpError
from edp.logs.proposal.columns import names_in_log
from edp.logs.read import find_recordings
from edp.logs.repair import Repair
from edp.logs.source import DataSource
from edp.signals import SignalMap


def read_as_before(source: DataSource, reader: Mapping[str, object]) -> DataSource:
    """Return the source with the map and repairs used for other logs, unless the source states its own map.

    Only where all of these had one map and the first log of the source has all of its columns; any other source stays
    as it is, and says what it lacks when it is read.

    Args:
        source: logs, or a folder of them; stores and data-set files have maps of their own.
        reader: how the other logs were read (`DataSource.to_dict`).
    """
    if source.signal_map is not None or source.stored or source.address or source.path.suffix == ".toml":
        return source
    try:
        before = _one_way(DataSource.from_dict(reader))
        if before is None:
            return source
        signal_map, repair = before
        columns = {entry.column for entry in signal_map.channels if entry.constant is None}
        names = names_in_log(find_recordings(source.path)[0])
    except EdpError:  # what is wrong with the source is told when it is read
        return source
    # Without columns to know the logs by, any log would be read so.
    if not columns or not columns <= names:
        return source
    return replace(source, signal_map=signal_map, repair=source.repair or repair)


def _one_way(before: DataSource) -> tuple[SignalMap, Repair | None] | None:
    """Return the common map of all logs of a source and the repairs of the first.

    None if there is no map, or several.
    """
    if before.signal_map is not None:
        return before.signal_map, before.repair
    logs = before.logs()
    first = logs[0].signal_map if logs else None
    if first is None or any(log.signal_map != first for log in logs):
        return None
    return first, logs[0].repair
