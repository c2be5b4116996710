"""Series: one contiguous segment of a recording, reduced to the columns that a task reads and predicts."""

from __future__ import annotations

from dataclasses import dataclass

from edp.recording import FloatArray


@dataclass(frozen=True, eq=False)
class Series:
    """Inputs and targets of one contiguous segment, in SI units.

    Attributes:
        name: name of the recording, with the row range for a part of a recording.
        inputs: inputs, float32 ``(time, input)``; row t contains the values available at sample t.
        targets: float32 ``(time, target)``; row t is the target channel *at* t (a horizon k asks for row t + k).
        strategy_columns: additional columns for a training strategy, float32 ``(time, column)``: teacher predictions,
            or the number of a domain or machine; None without additional columns.
        machine: machine of the recording; empty if unknown.
        recording: name of the source recording; empty if unknown.
    """

    name: str
    inputs: FloatArray
    targets: FloatArray
    strategy_columns: FloatArray | None = None
    machine: str = ""
    recording: str = ""

    @property
    def samples(self) -> int:
        """Number of ticks."""
        return int(self.inputs.shape[0])
