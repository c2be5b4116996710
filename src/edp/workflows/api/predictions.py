"""Predictions over whole recordings, as arrays, frames and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, DataError, closest, count_of
from edp.recording import FloatArray, Recording
from edp.report.notebook import BandLine, html_of, prediction_figure, text_of
from edp.report.run.figures import aligned
from edp.signals import KINDS, Channel, Kind
from edp.table import Column, Table
from edp.wording import typed
from edp.workflows.api.frames import OneFrame


@dataclass(frozen=True, eq=False, repr=False)
class Predictions(OneFrame):
    """Predictions for every sample of the given recordings, in SI units.

    A frame has the columns ``recording``, ``time_s`` of the tick, and one for each target and horizon: it is called
    ``TARGET+HORIZON``; bounds of an interval ``TARGET+HORIZON lower 0.9`` and ``... upper 0.9``.

    Attributes:
        recordings: recordings of the predictions.
        targets: predicted channels.
        kinds: kinds of the targets.
        horizons: look-ahead in samples.
        coverages: coverages of the intervals; empty for a network without intervals.
        values: predictions of each recording, float32 ``(time, horizon, target)``. Row t is the prediction at t of the
            values at t + horizon.
        bounds: interval bounds of each recording, float32 ``(time, coverage, 2, horizon, target)``, lower before upper;
            None without intervals.
    """

    recordings: tuple[Recording, ...]
    targets: tuple[str, ...]
    kinds: tuple[Kind, ...]
    horizons: tuple[int, ...]
    coverages: tuple[float, ...]
    values: tuple[FloatArray, ...]
    bounds: tuple[FloatArray, ...] | None = None

    def __len__(self) -> int:
        """Return the number of recordings."""
        return len(self.recordings)

    def to_numpy(self) -> list[FloatArray]:
        """Return one float32 array ``(time, horizon, target)`` per recording, SI units.

        Row t holds the predictions made at sample t.
        """
        return list(self.values)

    def plot(self, recording: int | str = 0, horizon: int | None = None) -> Any:
        """Plot predictions, shifted to the time that they predict, together with the measured values (Plotly).

        Args:
            recording: number or name.
            horizon: look-ahead in samples; the longest by default.

        Raises:
            ConfigError: no such horizon.
            DataError: no such recording.
        """
        which = self._number(recording)
        # The farthest horizon: near ones lie on the measured line and show nothing.
        ahead = max(self.horizons) if horizon is None else horizon
        if ahead not in self.horizons:
            raise ConfigError(f"horizon = {ahead}; this predictor has {', '.join(map(str, self.horizons))}")
        source = self.recordings[which]
        lines = [self._line(source, which, output, ahead) for output in range(len(self.targets))]
        title = f"{source.name}, {typed(1000 * ahead / source.rate_hz)} ms ahead"
        return prediction_figure(lines, source.rate_hz, title)

    def _number(self, recording: int | str) -> int:
        names = [entry.name for entry in self.recordings]
        if isinstance(recording, str):
            if recording not in names:
                raise DataError(f"there are no predictions of '{recording}'{closest(recording, names)}")
            return names.index(recording)
        # Negative numbers count from the end, as in any Python sequence.
        if not -len(names) <= recording < len(names):
            raise DataError(
                f"there are predictions of {count_of(len(names), 'recording')}; {recording} is not one of them"
            )
        return recording

    def _line(self, source: Recording, which: int, output: int, horizon: int) -> BandLine:
        column, name = self.horizons.index(horizon), self.targets[output]
        lower = upper = None
        if self.bounds is not None:
            # The first coverage is the widest.
            lower, upper = (aligned(self.bounds[which][:, 0, side, column, output], horizon) for side in (0, 1))
        return BandLine(
            channel=Channel(name, self.kinds[output]),
            predicted=aligned(self.values[which][:, column, output], horizon),
            measured=source.column(name) if name in source.channel_names else None,
            lower=lower,
            upper=upper,
        )

    def _columns(self) -> dict[str, NDArray[Any] | list[str]]:
        columns: dict[str, NDArray[Any] | list[str]] = {
            "recording": [entry.name for entry in self.recordings for _ in range(entry.samples)],
            "time_s": np.concatenate([np.arange(entry.samples) / entry.rate_hz for entry in self.recordings]),
        }
        for output, target in enumerate(self.targets):
            for number, horizon in enumerate(self.horizons):
                name = f"{target}+{horizon}"
                columns[name] = np.concatenate([values[:, number, output] for values in self.values])
                for which, coverage in enumerate(self.coverages if self.bounds is not None else ()):
                    for side, word in enumerate(("lower", "upper")):
                        parts = [bounds[:, which, side, number, output] for bounds in self.bounds or ()]
                        columns[f"{name} {word} {coverage:g}"] = np.concatenate(parts)
        return columns

    def _table(self) -> Table:
        rows = tuple((entry.name, f"{entry.samples:,}", f"{entry.duration_s:,.1f}") for entry in self.recordings)
        targets = [f"{name} [{KINDS[kind].si_unit}]" for name, kind in zip(self.targets, self.kinds, strict=True)]
        ahead = f"{', '.join(map(str, self.horizons))} sample(s) ahead"
        intervals = "".join(f", interval {typed(coverage)}" for coverage in self.coverages)
        caption = f"Predictions of {', '.join(targets)}, {ahead}{intervals}"
        return Table(caption, (Column("Recording"), Column("Samples"), Column("Duration", "s")), rows)

    def __repr__(self) -> str:
        """Return a summary table as text."""
        return text_of(self._table())

    def _repr_html_(self) -> str:
        """Return a summary table as HTML for a notebook."""
        return html_of([self._table()])
