"""Content of ``monitor_run.json``: summary of a monitor run, without its alarms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain

from edp.monitor.diagnosis.structure import MAX_PAIRS, Confusion
from edp.settings.bounds import check_bounds, check_count, check_texts, integer
from edp.settings.results import ResultFile

MAX_TEXT = 4096
"""Maximum number of characters of a text in the files of a monitor run."""


@dataclass(frozen=True, kw_only=True)
class MonitorRunFile(ResultFile):
    """Content of ``monitor_run.json``.

    Attributes:
        monitor: path of the monitor.
        promise: sentence of the calibration.
        recordings: number of recordings.
        silent: channels without a value, by recording.
        unlearned: reasons why a monitor has learned nothing for a recording, by recording.
        unlike: sentence about the difference from the recordings of the fit, by recording.
        outside: sentence about residuals outside of their healthy range without an alarm, by recording.
        unseen: sentence about faults that silence does not exclude.
        classes: number of faults of the dictionary; 0 without a dictionary.
        confusions: pairs of faults that cannot be told apart.
        files: hashes of other files of the folder, by name.
    """

    NAME = "monitor_run.json"
    WHAT = "monitor run"
    ADVICE = "run the monitor again"

    monitor: str
    promise: str
    recordings: int = 0
    silent: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    unlearned: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    unlike: Mapping[str, str] = field(default_factory=dict)
    outside: Mapping[str, str] = field(default_factory=dict)
    unseen: str = ""
    classes: int
    confusions: tuple[Confusion, ...]
    files: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_bounds("monitor run", self, recordings=integer(0, 10**9), classes=integer(0, 10**6))
        check_count("monitor run", "confusions", self.confusions, MAX_PAIRS)
        check_texts("monitor run", (self.promise, self.unseen, *self.remarks, *chain(*self.remarks.values())), MAX_TEXT)

    @property
    def remarks(self) -> dict[str, list[str]]:
        """Names of recordings by remark."""
        remarks: dict[str, list[str]] = {}
        for name, remark in (*self.outside.items(), *self.unlike.items()):
            remarks.setdefault(remark, []).append(name)
        for name, reasons in self.unlearned.items():
            for reason in reasons:
                remarks.setdefault(reason, []).append(name)
        return remarks
