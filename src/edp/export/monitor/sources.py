"""Sources of residuals as C: their memory, their constants, a function a source that fills the residuals of a tick."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np

from edp.export.c.model import Model, make_model
from edp.export.c.text import number
from edp.export.monitor.flows import FlowCode
from edp.export.monitor.numbers import MonitorTables
from edp.export.monitor.parts import BalancePart, FlowPart, NetworkPart, SourcePart, TwinPart

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
TURNS = """
/* Runs every {every} ticks, by turns with others; residuals hold in between, but not what came of a missing value. */
static void {own}_residuals({name}_state *s) {{
{hold}    if (s->{own}_due == 0u) {{
        const bool known = {model}_step(&s->{own}, s->{own}_in, &s->{own}_out) <= EDP_WARMING;
        const bool fed = all_there(s, {own}_reads, {reads}u);
        for (uint32_t i = 0; i < {residuals}u; i++) {{
            const float expected = (&s->{own}_out.prediction[0][0])[{own}_results[i]];
            const uint16_t judged = {own}_judged[i];
            s->{own}_kept[i] = (known && fed && s->there[judged]) ? (s->row[judged] - expected) : (float)edp_unknown();
        }}
        s->{own}_due = {every}u;
    }}
    s->{own}_due--;
    edp_copy(s->{own}_kept, {residuals}u, &s->residuals[{first}u]);
}}
"""
AHEAD = """
/* Predictions wait in a ring until what they are about is measured. */
static void {own}_residuals({name}_state *s) {{
    {model}_output *const out = &s->{own}_out;
{hold}    const bool known = {model}_step(&s->{own}, s->{own}_in, out) <= EDP_WARMING;
    for (uint32_t i = 0; i < {residuals}u; i++) {{
        const uint32_t back = (s->{own}_at + {length}u - {own}_delays[i]) % {length}u;
        const bool due = s->{own}_seen >= {own}_delays[i];
        s->{own}_past[s->{own}_at][i] = known ? (&out->prediction[0][0])[{own}_results[i]] : (float)edp_unknown();
{width}        s->residuals[{first}u + i] = due ? {value} : (float)edp_unknown();
    }}
    s->{own}_at = (s->{own}_at + 1u) % {length}u;
    s->{own}_seen += (s->{own}_seen < {length}u) ? 1u : 0u;
}}
"""
WIDTH = """\
        const float half = 0.5f * ((&out->upper[0][0][0])[{own}_results[i]] - (&out->lower[0][0][0])[{own}_results[i]]);
        s->{own}_width[s->{own}_at][i] = (half > {least}) ? half : {least};
"""
TWIN = """
/* A twin a group of its answers, whose ports are free but for a tick now and then. */
static void {own}_residuals({name}_state *s) {{
    {model}_output out;
    float row[{inputs}];
    uint32_t at = {first}u;
    const bool apart = (s->{own}_ticks >= {prefix}u) && (((s->{own}_ticks - {prefix}u) % {period}u) != 0u);
{hold}    for (uint32_t g = 0; g < {groups}u; g++) {{
        edp_copy(s->{own}_in, {reads}u, row);
        edp_fill(1.0f, {answers}u, &row[{reads}u]);
        for (uint32_t i = {own}_group_from[g]; i < {own}_group_from[g + 1u]; i++) {{
            const uint32_t answer = {own}_groups[i];
            const float expected = (s->{own}_ticks > 0u) ? s->{own}_expected[i] : row[{commands}u + answer];
            s->residuals[at] = row[{commands}u + answer] - expected;
            at++;
            if (apart) {{
                row[{commands}u + answer] = 0.0f;
                row[{reads}u + answer] = 0.0f;
            }}
        }}
        const bool known = {model}_step(&s->{own}[g], row, &out) <= EDP_WARMING;
        for (uint32_t i = {own}_group_from[g]; i < {own}_group_from[g + 1u]; i++) {{
            s->{own}_expected[i] = known ? out.prediction[0][{own}_groups[i]] : (float)edp_unknown();
        }}
    }}
    /* The count stays small for ever, and within a period tells the same. */
    s->{own}_ticks++;
    s->{own}_ticks -= (s->{own}_ticks >= ({prefix}u + {period}u)) ? {period}u : 0u;
}}
"""
BALANCE = """
/* Levels less the integrals of their rates; what is older fades, and what happened while a value was missing is not
   known. */
static void {own}_residuals({name}_state *s) {{
{hold}    for (uint32_t i = 0; i < {residuals}u; i++) {{
        const double level = (double)s->{own}_in[{own}_levels[i]];
        const double step = (double)s->{own}_in[{own}_rates[i]] * {own}_steps[i];
        const bool now = s->there[{own}_reads[{own}_levels[i]]];
        const bool whole = s->{own}_began && now && s->{own}_known[i] && s->there[{own}_reads[{own}_rates[i]]];
        const double change = whole ? ((level - s->{own}_level[i]) - step) : 0.0;
        s->{own}_sum[i] = ({own}_left[i] * s->{own}_sum[i]) + change;
        s->{own}_level[i] = level;
        s->{own}_known[i] = now;
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
        """Return the function that fills the residuals beginning at `first`."""
        ...

    def reset(self) -> list[str]:
        """Statements that set the state at the start."""
        ...

    def forget(self) -> list[str]:
        """Return the statements after a gap, which invalidate the stored past."""
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
        self.ahead = part.scaled or max(part.delays) > 0
        self.turns = part.every > 1

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        lines = [f"{self.prefix}_state {self.own};", f"float {self.own}_in[{len(self.part.reads)}];"]
        lines += [f"{self.prefix}_output {self.own}_out; /* to be read: what the network said last */"]
        if self.ahead:
            lines += [f"uint32_t {self.own}_at;", f"uint32_t {self.own}_seen;"]
            rings = ("past", "width") if self.part.scaled else ("past",)
            lines += [f"float {self.own}_{ring}[{max(self.part.delays) + 1}][{self.residuals}];" for ring in rings]
        if self.turns:
            lines += [
                f"uint32_t {self.own}_due; /* ticks until it runs */",
                f"float {self.own}_kept[{self.residuals}];",
            ]
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

    def code(self, name: str, first: int) -> str:
        """See `SourceCode`."""
        own, part = self.own, self.part
        value = f"(s->row[{own}_judged[i]] - s->{own}_past[back][i])"
        blanks: dict[str, object] = {
            "own": own,
            "name": name,
            "model": self.prefix,
            "hold": HOLD.format(own=own, count=len(part.reads)),
            "residuals": self.residuals,
            "first": first,
            "width": WIDTH.format(own=own, least=number(part.least_width)) if part.scaled else "",
            "value": f"({value} / s->{own}_width[back][i])" if part.scaled else value,
            "length": max(part.delays) + 1,
            "every": part.every,
            "reads": len(part.reads),
        }
        return (AHEAD if self.ahead else TURNS if self.turns else NETWORK).format(**blanks)

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        filled_inputs = f"edp_copy({self.own}_middle, {len(self.part.reads)}u, s->{self.own}_in);"
        due = [f"s->{self.own}_due = {self.part.first}u;"] if self.turns else []
        return [f"{self.prefix}_reset(&s->{self.own});", filled_inputs, *due, *self._unknown()]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        seen = [f"s->{self.own}_seen = 0u;"] if self.ahead else []
        return [f"{self.prefix}_reset(&s->{self.own});", *seen, *self._unknown()]

    def _unknown(self) -> list[str]:
        """Statements after which its residuals are not known until it runs."""
        return [f"edp_fill((float)edp_unknown(), {self.residuals}u, s->{self.own}_kept);"] if self.turns else []


class BalanceCode:
    """Balances; see `BalancePart`."""

    def __init__(self, part: BalancePart, own: str) -> None:
        self.part, self.own = part, own
        self.model: Model | None = None
        self.residuals = len(part.levels)

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        sums = [f"double {self.own}_{what}[{self.residuals}];" for what in ("level", "sum")]
        flags = f"bool {self.own}_known[{self.residuals}];"
        return [f"float {self.own}_in[{len(self.part.reads)}];", *sums, f"bool {self.own}_began;", flags]

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


class TwinCode:
    """A twin with free ports; see `TwinPart`.

    Args:
        part: what it is.
        own: prefix of its names within the monitor.
        model: C prefix of its plant.
    """

    def __init__(self, part: TwinPart, own: str, model: str) -> None:
        self.part, self.own, self.prefix = part, own, model
        self.model: Model | None = make_model(model, part.bundle)
        self.residuals = sum(map(len, part.groups))

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        lines = [f"{self.prefix}_state {self.own}[{len(self.part.groups)}];", f"uint32_t {self.own}_ticks;"]
        return [
            *lines,
            f"float {self.own}_in[{len(self.part.reads)}];",
            f"float {self.own}_expected[{self.residuals}];",
        ]

    def constants(self, tables: MonitorTables) -> None:
        """See `SourceCode`."""
        groups = self.part.groups
        tables.places(f"{self.own}_reads", self.part.reads)
        tables.places(f"{self.own}_groups", [answer for group in groups for answer in group])
        tables.places(f"{self.own}_group_from", np.cumsum([0, *map(len, groups)]).tolist())
        tables.floats(f"{self.own}_middle", self.part.middle)

    def code(self, name: str, first: int) -> str:
        """See `SourceCode`."""
        part, reads, answers = self.part, len(self.part.reads), len(self.part.bundle.task.targets)
        return TWIN.format(
            own=self.own,
            name=name,
            model=self.prefix,
            hold=HOLD.format(own=self.own, count=reads),
            first=first,
            inputs=reads + answers,
            reads=reads,
            answers=answers,
            commands=reads - answers,
            groups=len(part.groups),
            prefix=part.prefix,
            period=part.period,
        )

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        return [*self.forget(), f"edp_copy({self.own}_middle, {len(self.part.reads)}u, s->{self.own}_in);"]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        groups = range(len(self.part.groups))
        return [*(f"{self.prefix}_reset(&s->{self.own}[{g}]);" for g in groups), f"s->{self.own}_ticks = 0u;"]


def source_code(part: SourcePart, index: int, name: str) -> SourceCode:
    """Return the code writer for one residual source of the monitor `name`.

    Raises:
        ExportError: its network has no form in C.
    """
    if isinstance(part, NetworkPart):
        return NetworkCode(part, f"n{index}", f"{name}_n{index}")
    if isinstance(part, TwinPart):
        return TwinCode(part, f"t{index}", f"{name}_t{index}")
    if isinstance(part, FlowPart):
        return FlowCode(part, f"f{index}", HOLD.format(own=f"f{index}", count=len(part.reads)))
    return BalanceCode(part, f"b{index}")


def reads_tables(reads: Sequence[tuple[int, ...]], tables: MonitorTables) -> None:
    """Add the table of inputs of all residuals, concatenated, and the table of their starts."""
    tables.places("reads", [column for columns in reads for column in columns])
    tables.places("reads_from", np.cumsum([0, *(len(columns) for columns in reads)]).tolist())
