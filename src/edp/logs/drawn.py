"""Evenly spaced segments of recordings, for commands that use only some hours of a large data set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from edp.errors import ConfigError
from edp.logs.quality.checks import Finding
from edp.recording import STRETCH_S, Recording, spread_recordings
from edp.wording import setting_text, typed


@dataclass(frozen=True)
class Drawn:
    """Amount of data selected from a data set.

    Attributes:
        hours: total length of the segments, h.
        of_hours: total length of all recordings, h.
        stretches: number of segments.
    """

    hours: float
    of_hours: float
    stretches: int

    @property
    def what(self) -> str:
        """The same in words."""
        return (
            f"{typed(self.hours, 3)} of {typed(self.of_hours)} h: {self.stretches:,} evenly spread stretch(es) of them"
        )


def check_hours(hours: float) -> float:
    """Check the hours of a sample and return them.

    Raises:
        ConfigError: not a positive, finite number.
    """
    if not 0.0 < hours < float("inf"):
        raise ConfigError(f"--max-hours {setting_text(hours)}: a positive number of hours must hold")
    return hours


def draw_recordings(recordings: Sequence[Recording], hours: float) -> list[Recording]:
    """Return at most about `hours` of the recordings, as evenly spaced segments of `STRETCH_S` if there are more."""
    most = max(1, round(3600.0 * hours * recordings[0].rate_hz))
    return spread_recordings(recordings, STRETCH_S, most)


def findings_of_part(recordings: Sequence[Recording], of_hours: float) -> tuple[Finding, ...]:
    """Return the inspection finding that states how many of the hours were used; empty if all were."""
    hours = sum(recording.samples / recording.rate_hz for recording in recordings) / 3600.0
    drawn = Drawn(hours, of_hours, len(recordings))
    if drawn.hours == drawn.of_hours:
        return ()
    return (Finding("note", None, f"looked at {drawn.what}", drawn.stretches, "", "leave --max-hours out for all"),)
