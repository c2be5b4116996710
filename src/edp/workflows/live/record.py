"""``--record``: a session as MCAP with channels in JSON, which Foxglove and EDP read."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, StorageError
from edp.live.layout import LiveLayout
from edp.signals import Channel
from edp.storage.reading import Table

ROWS, FORECASTS, EVENTS, FACTS = "/edp/recording", "/edp/predictions", "/edp/events", "/edp/info"


class McapRecorder:
    """Writes rows as they come.

    Args:
        path: path of the file, which must not exist.
        channels: channels of the first columns of a row.
        layout: layout of all columns.

    Raises:
        ConfigError: another ending, or foxglove-sdk is not installed.
        StorageError: the file is there already, or cannot be written.
    """

    def __init__(self, path: str | Path, channels: tuple[Channel, ...], layout: LiveLayout) -> None:
        self.path = Path(path)
        if self.path.suffix.lower() != ".mcap":
            raise ConfigError(f"--record {path}: the file of a session ends in .mcap")
        try:
            import foxglove
        except ImportError as error:
            raise ConfigError(
                "--record needs the package foxglove-sdk, which is not installed; run pip install "
                "'excavator-dynamics-predictor[live]', or save the session as a page (--save)"
            ) from error
        self._channels, self._layout = channels, layout
        self._context = foxglove.Context()
        try:
            self._writer = foxglove.open_mcap(self.path, context=self._context)
        except (OSError, RuntimeError, FileExistsError) as error:
            raise StorageError(f"--record {path}: {error}; choose a new file in a folder that is there") from error

        def channel(topic: str, schema: Table) -> Any:
            return foxglove.Channel(topic, schema=schema, message_encoding="json", context=self._context)

        numbers = {"type": "object", "additionalProperties": {"type": ["number", "null"]}}
        texts = {"type": "object", "properties": {"kind": {"type": "string"}, "text": {"type": "string"}}}
        self._rows, self._predicted = channel(ROWS, numbers), channel(FORECASTS, numbers)
        self._events, self._facts = channel(EVENTS, texts), channel(FACTS, {"type": "object"})
        self._names = [
            (f"{one.name} {'twin' if one.model != 'network' else one.ticks}{suffix}", column)
            for one in layout.forecasts
            for suffix, column in (("", one.column), (" low", one.lower), (" high", one.upper))
            if column is not None
        ]
        self._facts.log(json.dumps(self._describe()).encode(), log_time=0)

    def row(self, tick: int, row: NDArray[np.float32]) -> None:
        """Write a row of the session at its time."""
        at_ns = round(tick * 1e9 / self._layout.rate_hz)
        values = row.tolist()
        named = {channel.name: _plain(values[n]) for n, channel in enumerate(self._channels)}
        self._rows.log(json.dumps(named).encode(), log_time=at_ns)
        if self._names:
            predicted = {name: _plain(values[column]) for name, column in self._names}
            self._predicted.log(json.dumps(predicted).encode(), log_time=at_ns)

    def event(self, tick: int, kind: str, text: str) -> None:
        """Write an event."""
        at_ns = round(tick * 1e9 / self._layout.rate_hz)
        self._events.log(json.dumps({"kind": kind, "text": text}).encode(), log_time=at_ns)

    def close(self) -> None:
        """Finish the file; without its end no reader takes it."""
        self._writer.close()

    def _describe(self) -> dict[str, object]:
        """Return the data of `edp.logs.formats.edp_metadata.facts_text` without a digest, unknown until the end."""
        channels = [
            {"name": c.name, "unit": c.unit, "kind": str(c.kind), "description": c.description} for c in self._channels
        ]
        return {
            "name": self.path.stem,
            "rate_hz": self._layout.rate_hz,
            "source": self._layout.source,
            "meta": {},
            "channels": channels,
        }


def _plain(value: float) -> float | None:
    # float32 to the digits that it has: "0.1", not "0.10000000149011612".
    return float(np.format_float_scientific(np.float32(value))) if math.isfinite(value) else None
