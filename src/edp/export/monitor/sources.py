"""Sources of residuals as C: their memory, their constants, a function a source that fills the residuals of a tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from edp.export.c.model import Model, make_model
from edp.export.c.text import number
from edp.export.monitor.numbers import MonitorTables
from edp.export.monitor.parts import BalancePart, NetworkPart, SourcePart

HOLD = """\
    for (uint32_t i = 0; i < {count}u; i++) {{
        if (s->there[{own}_reads[i]]) {{
            s->{own}_in[i] = s->row[{own}_reads[i]]; /* else the last value stands in */
        }}
    }}
"""
NETWORK = """
static void {own}_residuals({name}_state *s) {{
    {model}_output out;
{hold}    const bool known = {model}_step(&s->{own}, s->{own}_in, &out) <= EDP_WARMING;
    for (uint32_t i = 0; i < {residuals}u; i++) {{
        const float expected = (&out.prediction[0][0])[{own}_results[i]];
        s->residuals[{first}u + i] = known ? (s->row[{own}_judged[i]] - expected) : (float)edp_unknown();
    }}
}}
"""
AHEAD = """
/* Predictions wait in a ring until what they are about is measured. */
static void {own}_residuals({name}_state *s) {{
    {model}_output out;
{hold}    const bool known = {model}_step(&s->{own}, s->{own}_in, &out) <= EDP_WARMING;
    for (uint32_t i = 0; i < {residuals}u; i++) {{
        const uint32_t back = (s->{own}_at + {length}u - {own}_delays[i]) % {length}u;
        s->{own}_past[s->{own}_at][i] = known ? (&out.prediction[0][0])[{own}_results[i]] : (float)edp_unknown();
        const float expected = (s->{own}_seen >= {own}_delays[i]) ? s->{own}_past[back][i] : (float)edp_unknown();
        s->residuals[{first}u + i] = (s->row[{own}_judged[i]] - expected) / {own}_widths[i];
    }}
    s->{own}_at = (s->{own}_at + 1u) % {length}u;
    s->{own}_seen += (s->{own}_seen < {length}u) ? 1u : 0u;
}}
"""
BALANCE = """
/* Levels less the integrals of their rates; what is older fades. */
static void {own}_residuals({name}_state *s) {{
{hold}    for (uint32_t i = 0; i < {residuals}u; i++) {{
        const double level = (double)s->{own}_in[{own}_levels[i]];
        const double step = (double)s->{own}_in[{own}_rates[i]] * {own}_steps[i];
        const double change = s->{own}_began ? ((level - s->{own}_level[i]) - step) : 0.0;
        s->{own}_sum[i] = ({own}_left[i] * s->{own}_sum[i]) + change;
        s->{own}_level[i] = level;
        s->residuals[{first}u + i] = (float)s->{own}_sum[i];
    }}
    s->{own}_began = true;
}}
"""


class SourceCode(Protocol):
    """A source in C.

    Attributes:
        model: its network; None without one.
        residuals: how many it has.
    """

    model: Model | None
    residuals: int

    def fields(self) -> list[str]:
        """Members of the monitor's state."""
        ...

    def constants(self, tables: MonitorTables) -> None:
        """Enter the constants."""
        ...

    def code(self, name: str, first: int) -> str:
        """The function that fills the residuals from `first` on."""
        ...

    def reset(self) -> list[str]:
        """Statements that set the state at the start."""
        ...

    def forget(self) -> list[str]:
        """Statements after a gap: what is known of the past is not trusted any more."""
        ...


class NetworkCode:
    """A virtual sensor or a look-ahead network.

    Args:
        part: what it is.
        own: prefix of its names within the monitor.
        model: C prefix of its network.
    """

    def __init__(self, part: NetworkPart, own: str, model: str) -> None:
        self.part, self.own = part, own
        self.model: Model | None = make_model(model, part.bundle)
        self.prefix = model
        self.residuals = len(part.judged)
        self.ahead = bool(part.delays) and (max(part.delays) > 0 or bool((part.widths != 1.0).any()))

    @property
    def _length(self) -> int:
        return max(self.part.delays) + 1

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        lines = [f"{self.prefix}_state {self.own};", f"float {self.own}_in[{len(self.part.reads)}];"]
        if self.ahead:
            lines += [f"uint32_t {self.own}_at;", f"uint32_t {self.own}_seen;"]
            lines += [f"float {self.own}_past[{self._length}][{self.residuals}];"]
        return lines

    def constants(self, tables: MonitorTables) -> None:
        """See `SourceCode`."""
        part = self.part
        tables.places(f"{self.own}_reads", part.reads)
        tables.places(f"{self.own}_judged", part.judged)
        tables.places(f"{self.own}_results", part.results)
        tables.floats(f"{self.own}_middle", part.middle)
        if self.ahead:
            tables.places(f"{self.own}_delays", part.delays)
            tables.floats(f"{self.own}_widths", part.widths)

    def code(self, name: str, first: int) -> str:
        """See `SourceCode`."""
        hold = HOLD.format(own=self.own, count=len(self.part.reads))
        return (AHEAD if self.ahead else NETWORK).format(
            own=self.own,
            name=name,
            model=self.prefix,
            hold=hold,
            residuals=self.residuals,
            first=first,
            length=self._length if self.ahead else 0,
        )

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        held = f"edp_copy({self.own}_middle, {len(self.part.reads)}u, s->{self.own}_in);"
        return [f"{self.prefix}_reset(&s->{self.own});", held]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        return [f"{self.prefix}_reset(&s->{self.own});", *([f"s->{self.own}_seen = 0u;"] if self.ahead else [])]


class BalanceCode:
    """Balances; see `BalancePart`."""

    def __init__(self, part: BalancePart, own: str) -> None:
        self.part, self.own = part, own
        self.model: Model | None = None
        self.residuals = len(part.levels)

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        sums = [f"double {self.own}_{what}[{self.residuals}];" for what in ("level", "sum")]
        return [f"float {self.own}_in[{len(self.part.reads)}];", *sums, f"bool {self.own}_began;"]

    def constants(self, tables: MonitorTables) -> None:
        """See `SourceCode`."""
        part = self.part
        for what, places in (("reads", part.reads), ("levels", part.levels), ("rates", part.rates)):
            tables.places(f"{self.own}_{what}", places)
        tables.floats(f"{self.own}_middle", part.middle)
        tables.doubles(f"{self.own}_steps", part.steps)
        tables.doubles(f"{self.own}_left", part.left)

    def code(self, name: str, first: int) -> str:
        """See `SourceCode`."""
        hold = HOLD.format(own=self.own, count=len(self.part.reads))
        return BALANCE.format(own=self.own, name=name, hold=hold, residuals=self.residuals, first=first)

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        return [f"edp_copy({self.own}_middle, {len(self.part.reads)}u, s->{self.own}_in);"]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        return [f"s->{self.own}_began = false;", f"edp_clear({self.residuals}u, s->{self.own}_sum);"]


def source_code(part: SourcePart, place: int, name: str) -> SourceCode:
    """The source at a place of the monitor `name`.

    Raises:
        ExportError: its network has no form in C.
    """
    if isinstance(part, NetworkPart):
        return NetworkCode(part, f"n{place}", f"{name}_n{place}")
    return BalanceCode(part, f"b{place}")


def reads_tables(reads: Sequence[tuple[int, ...]], tables: MonitorTables) -> None:
    """Inputs of every residual, one behind the other, and where each begins."""
    tables.places("reads", [place for places in reads for place in places])
    tables.places("reads_from", np.cumsum([0, *(len(places) for places in reads)]).tolist())


__all__ = ["BalanceCode", "NetworkCode", "SourceCode", "number", "reads_tables", "source_code"]
