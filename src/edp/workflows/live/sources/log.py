"""``--log``: a recording at its own pace."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from edp.data.derived_velocities import matched
from edp.logs.source import DataSource, read_with_truth
from edp.recording import MACHINE, Recording
from edp.wording import typed
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Sink, SourceOptions

SIMULATED = "sim:"


@SOURCES.register("log")
class LogSource(LiveSource):
    """One log, from its first row to its last."""

    options: ClassVar[frozenset[str]] = frozenset({"map", "machine", "speed", "until-end"})

    def __init__(self, recording: Recording, machine: str | None = None) -> None:
        self.recording: Recording = recording
        self.channels, self.rate_hz, self.ticks = recording.channels, recording.rate_hz, recording.samples
        self.machine = machine or _machine_of(recording)
        self.text = f"log {recording.name}, {typed(recording.duration_s)} s"
        self.ending = f"the log has ended after {typed(recording.duration_s)} s"

    @classmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> LogSource:
        """Return `SourceOptions.value` is the path of one log."""
        recording = read_with_truth(
            DataSource(Path(options.value), options.signal_map(), options.settings.get("repair"))
        )
        if needs.twin is not None:
            # A twin's velocities follow from strokes where the log has none, as when it is judged.
            recording = matched(needs.twin, recording)
        return cls(recording, options.machine)

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        for row in self.recording.values:
            sink.take(row)


def _machine_of(recording: Recording) -> str | None:
    named = recording.meta.get(MACHINE)
    if isinstance(named, str) and named:
        return named
    return recording.source.removeprefix(SIMULATED) if recording.source.startswith(SIMULATED) else None
