"""Values over several ticks, as rows ``(tick, number)`` and, for convolutions, as columns ``(1, number, tick)``."""

from __future__ import annotations

from dataclasses import dataclass

from edp.export.onnx.nodes import Nodes


@dataclass
class _Value:
    """The last `ticks` samples of a value with `width` elements, as rows, columns or both."""

    ticks: int
    width: int
    rows: str = ""
    columns: str = ""


class Sequences:
    """Values by name; each form is created on first use."""

    def __init__(self, nodes: Nodes) -> None:
        self._nodes = nodes
        self._values: dict[str, _Value] = {}
        self._cut: dict[tuple[str, int, int], str] = {}

    def known(self, name: str) -> bool:
        """Return whether a value was given."""
        return name in self._values

    def give(self, name: str, rows: str, ticks: int, width: int) -> None:
        """Enter a value as rows."""
        self._values[name] = _Value(ticks, width, rows=rows)

    def give_columns(self, name: str, columns: str, ticks: int, width: int) -> None:
        """Enter a value as columns."""
        self._values[name] = _Value(ticks, width, columns=columns)

    def in_columns(self, name: str, ticks: int) -> bool:
        """Return whether these last ticks are there as columns."""
        form = self._values[name]
        return bool(form.columns) and form.ticks == ticks

    def rows(self, name: str, ticks: int) -> str:
        """Return the last `ticks` samples as rows."""
        form = self._values[name]
        if not form.rows:
            # Convolutions want channels before time, everything else time before channels.
            turned = self._nodes.add("Transpose", form.columns, perm=[0, 2, 1])
            form.rows = self._nodes.shaped(turned, form.ticks, form.width)
        return self._last(form.rows, form.ticks, ticks, 0)

    def columns(self, name: str, ticks: int) -> str:
        """Return the last `ticks` samples as columns."""
        form = self._values[name]
        if not form.columns:
            three = self._nodes.shaped(form.rows, 1, form.ticks, form.width)
            form.columns = self._nodes.add("Transpose", three, perm=[0, 2, 1])
        return self._last(form.columns, form.ticks, ticks, 2)

    def _last(self, value: str, had: int, ticks: int, axis: int) -> str:
        if had == ticks:
            return value
        key = (value, ticks, axis)
        if key not in self._cut:
            self._cut[key] = self._nodes.split(value, [had - ticks, ticks], axis)[1]
        return self._cut[key]
