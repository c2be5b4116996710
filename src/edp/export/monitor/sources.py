"""Sources of residuals as C: their memory, their constants, a function a source that fills the residuals of a tick."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from edp.export.c.model import Model, make_model
from edp.export.c.tables import ConstantTables
from edp.export.c.text import bool_literal, number, table, unsigned_literals
from edp.export.escape import Code, fill_file
from edp.export.monitor.parts import NetworkPart, SourcePart, TwinPart
from edp.monitor.residuals.balances import Balances
from edp.monitor.residuals.flow_balances import ChamberCurves, FlowBalances
from edp.monitor.residuals.flow_curves import BACK, CAVITY, EMPTY, KNOTS, RELIEFS, SMOOTH
from edp.training.bundle import Bundle

NO_PLACE = 0xFFFF
"""Index of a missing command."""
DOUBTFUL = 1
"""Index in `RELIEFS` of the pressure above which a flow balance is uncertain."""


class SourceCode(ABC):
    """A source in C.

    Args:
        own: prefix of its names within the monitor.
        reads: inputs of the monitor that it is fed, in its order.
        middle: substitute for each input that was never received, shape (reads,).
        residuals: number of residuals.
    """

    model: Model | None = None
    """Network of the source; None without a network."""
    template: str
    """Name of the template of the source's function."""

    def __init__(self, own: str, reads: Sequence[int], middle: NDArray[np.float32], residuals: int) -> None:
        self.own, self.reads, self.middle, self.residuals = own, tuple(reads), middle, residuals

    @abstractmethod
    def fields(self) -> list[str]:
        """Return the members of the monitor's state."""

    @property
    @abstractmethod
    def bytes(self) -> int:
        """Size of the members in bytes, without the states of a network's layers."""

    @abstractmethod
    def constants(self, tables: ConstantTables) -> None:
        """Enter the constants."""

    @abstractmethod
    def forget(self) -> list[str]:
        """Return the statements after a gap, which invalidate the stored past."""

    @abstractmethod
    def blanks(self, first: int) -> dict[str, object]:
        """Return the values of the template of the function that are its own; `first` as in `code`."""

    def reset(self) -> list[str]:
        """Return the statements that set the state at the start."""
        return [f"edp_copy({self.own}_middle, {len(self.reads)}u, s->{self.own}_in);"]

    def code(self, name: str, first: int) -> Code:
        """Return the function that fills the residuals of the monitor `name` beginning at `first`."""
        reads, blanks = len(self.reads), self.blanks(first)
        hold = self.fill_template("hold", {"count": reads})
        common = {"name": name, "hold": hold, "first": first, "residuals": self.residuals, "reads": reads}
        return self.fill_template(self.template, {**common, **blanks})

    def fill_template(self, template: str, values: Mapping[str, object]) -> Code:
        """Return a filled template of a source."""
        return fill_file(f"monitor/templates/source_{template}.c.in", {"own": self.own, **values})


class NetworkCode(SourceCode):
    """A virtual sensor or a look-ahead network.

    Args:
        part: network.
        own: prefix of its names within the monitor.
        model: C prefix of its network.
    """

    def __init__(self, part: NetworkPart, own: str, model: str) -> None:
        super().__init__(own, part.reads, part.middle, len(part.judged))
        self.part, self.prefix = part, model
        self.model = make_model(model, part.bundle)
        self.ahead = part.scaled or max(part.delays) > 0
        self.turns = part.every > 1
        self.template = "ahead" if self.ahead else "turns" if self.turns else "network"

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        lines = [f"{self.prefix}_state {self.own};", f"float {self.own}_in[{len(self.reads)}];"]
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

    @property
    def bytes(self) -> int:
        """See `SourceCode`."""
        part, task = self.part, self.part.bundle.task
        intervals = 2 * len(part.bundle.predictor.output.coverages)
        out = len(task.targets) * len(task.horizons) * (1 + intervals)
        ring = (max(part.delays) + 1) * self.residuals if max(part.delays) else 0
        last = 1 + self.residuals if self.turns else 0
        return 4 * (len(self.reads) + out + ring * (2 if part.scaled else 1) + last) + _network_bytes(part.bundle)

    def constants(self, tables: ConstantTables) -> None:
        """See `SourceCode`."""
        part = self.part
        tables.places(f"{self.own}_reads", self.reads)
        tables.places(f"{self.own}_judged", part.judged)
        tables.places(f"{self.own}_results", part.results)
        tables.floats(f"{self.own}_middle", self.middle)
        if self.ahead:
            tables.places(f"{self.own}_delays", part.delays)

    def blanks(self, first: int) -> dict[str, object]:
        """See `SourceCode`."""
        own, part = self.own, self.part
        value = f"(s->row[{own}_judged[i]] - s->{own}_past[back][i])"
        width = self.fill_template("ahead_width", {"least": number(part.least_width)}) if part.scaled else Code("")
        return {
            "model": self.prefix,
            "width": width,
            "value": Code(f"({value} / s->{own}_width[back][i])" if part.scaled else value),
            "length": max(part.delays) + 1,
            "every": part.every,
        }

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        due = [f"s->{self.own}_due = {self.part.first}u;"] if self.turns else []
        return [f"{self.prefix}_reset(&s->{self.own});", *super().reset(), *due, *self._unknown()]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        seen = [f"s->{self.own}_seen = 0u;"] if self.ahead else []
        return [f"{self.prefix}_reset(&s->{self.own});", *seen, *self._unknown()]

    def _unknown(self) -> list[str]:
        """Return the statements after which its residuals are not known until it runs."""
        return [f"edp_fill((float)edp_unknown(), {self.residuals}u, s->{self.own}_kept);"] if self.turns else []


class BalanceCode(SourceCode):
    """Levels less the integrals of their rates, with sums that fade."""

    template = "balance"

    def __init__(self, source: Balances, own: str, columns: Mapping[str, int]) -> None:
        super().__init__(own, [columns[name] for name in source.inputs], source.middle, len(source.pairs))
        self.source = source

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        sums = [f"double {self.own}_{what}[{self.residuals}];" for what in ("level", "sum")]
        flags = f"bool {self.own}_known[{self.residuals}];"
        return [f"float {self.own}_in[{len(self.reads)}];", *sums, f"bool {self.own}_began;", flags]

    @property
    def bytes(self) -> int:
        """See `SourceCode`."""
        return 4 * len(self.reads) + 17 * self.residuals + 7

    def constants(self, tables: ConstantTables) -> None:
        """See `SourceCode`."""
        source, (levels, rates) = self.source, self.source.pairs.T.tolist()
        for what, places in (("reads", self.reads), ("levels", levels), ("rates", rates)):
            tables.places(f"{self.own}_{what}", places)
        tables.floats(f"{self.own}_middle", self.middle)
        tables.doubles(f"{self.own}_steps", source.gains / source.rate_hz)
        tables.doubles(f"{self.own}_left", 1.0 - 1.0 / (source.memories_s * source.rate_hz))

    def blanks(self, first: int) -> dict[str, object]:
        """See `SourceCode`."""
        return {}

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        return [f"s->{self.own}_began = false;", f"edp_clear({self.residuals}u, s->{self.own}_sum);"]


class TwinCode(SourceCode):
    """A twin with free ports; see `TwinPart`.

    Args:
        part: twin.
        own: prefix of its names within the monitor.
        model: C prefix of its plant.
    """

    template = "twin"

    def __init__(self, part: TwinPart, own: str, model: str) -> None:
        super().__init__(own, part.reads, part.middle, sum(map(len, part.groups)))
        self.part, self.prefix = part, model
        self.model = make_model(model, part.bundle)

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        lines = [f"{self.prefix}_state {self.own}[{len(self.part.groups)}];", f"uint32_t {self.own}_ticks;"]
        return [*lines, f"float {self.own}_in[{len(self.reads)}];", f"float {self.own}_expected[{self.residuals}];"]

    @property
    def bytes(self) -> int:
        """See `SourceCode`."""
        return 4 * (len(self.reads) + self.residuals + 1) + len(self.part.groups) * _network_bytes(self.part.bundle)

    def constants(self, tables: ConstantTables) -> None:
        """See `SourceCode`."""
        groups = self.part.groups
        tables.places(f"{self.own}_reads", self.reads)
        tables.places(f"{self.own}_groups", [answer for group in groups for answer in group])
        tables.places(f"{self.own}_group_from", np.cumsum([0, *map(len, groups)]).tolist())
        tables.floats(f"{self.own}_middle", self.middle)

    def blanks(self, first: int) -> dict[str, object]:
        """See `SourceCode`."""
        part, reads, answers = self.part, len(self.reads), len(self.part.bundle.task.targets)
        return {
            "model": self.prefix,
            "inputs": reads + answers,
            "answers": answers,
            "commands": reads - answers,
            "groups": len(part.groups),
            "prefix": part.prefix,
            "period": part.period,
        }

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        return [*self.forget(), *super().reset()]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        groups = range(len(self.part.groups))
        return [*(f"{self.prefix}_reset(&s->{self.own}[{g}]);" for g in groups), f"s->{self.own}_ticks = 0u;"]


class FlowCode(SourceCode):
    """Balances of flow: spool positions from commands, opening curves, and one residual per chamber."""

    template = "flow"

    def __init__(self, source: FlowBalances, own: str, columns: Mapping[str, int]) -> None:
        super().__init__(own, [columns[name] for name in source.inputs], source.middle, len(source.chambers))
        self.source = source
        self.length = source.spools.memory + 1
        """Number of stored rows, including the present one."""

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        own, spools, reads = self.own, len(self.source.spools.gain), len(self.reads)
        memory = [f"float {own}_in[{reads}];", f"float {own}_past[{self.length}][{reads}];", f"uint32_t {own}_at;"]
        stages = [f"float {own}_{stage}[{spools}][2];" for stage in ("first", "second")]
        return [*memory, *stages, f"float {own}_played[{spools}];", f"bool {own}_began;"]

    @property
    def bytes(self) -> int:
        """See `SourceCode`."""
        return 4 * ((self.length + 1) * len(self.reads) + 5 * len(self.source.spools.gain)) + 8

    def constants(self, tables: ConstantTables) -> None:
        """See `SourceCode`."""
        spools, chambers, own = self.source.spools, self.source.chambers, self.own
        tables.places(f"{own}_reads", self.reads)
        for name, columns in (("extend", spools.extend), ("retract", spools.retract)):
            tables.places(f"{own}_{name}", map(_place, columns.tolist()))
        whole = np.floor(spools.dead).astype(int)
        tables.places(f"{own}_late", (whole + BACK).tolist())
        tables.floats(f"{own}_part", spools.dead - whole)
        tables.floats(f"{own}_middle", self.middle)
        for name in ("gain", "stages", "play"):
            tables.floats(f"{own}_{name}", getattr(spools, name))
        tables.floats(f"{own}_knots", KNOTS)
        tables.floats(f"{own}_reliefs", RELIEFS)
        for name in ("values", "slopes", "lines", "doubts"):
            tables.floats(f"{own}_{name}", np.concatenate([getattr(chamber, name) for chamber in chambers]))
        tables.places(f"{own}_pumps", [pump for chamber in chambers for pump in chamber.spots.supplies])
        tables.text(fill_file("monitor/templates/source_flow.h.in", {"own": own}).rstrip())
        paths = np.cumsum([0, *(len(chamber.values) for chamber in chambers)]).tolist()
        pumps = np.cumsum([0, *(len(chamber.spots.supplies) for chamber in chambers)]).tolist()
        rows = [self._chamber(index, chamber, paths[index], pumps[index]) for index, chamber in enumerate(chambers)]
        tables.text(table(f"{own}_chamber", f"{own}_chambers[{len(rows)}]", rows))

    def _chamber(self, index: int, chamber: ChamberCurves, path: int, pump: int) -> list[str]:
        """Return the members of a chamber's struct; its first curve is `path`, its first pump `pump`."""
        spots = chamber.spots
        second = spots.spools[1] if len(spots.spools) > 1 else NO_PLACE
        places = [spots.velocity, spots.own, spots.other, _place(spots.stroke)]
        places += [spots.spools[0], second, path, pump, len(spots.supplies)]
        numbers = (spots.end, spots.far, 1.0 / spots.cushion, spots.tank)
        lines = f"&{self.own}_lines[{index * len(chamber.lines)}]"
        doubts = f"&{self.own}_doubts[{index * len(chamber.doubts)}]"
        return [*unsigned_literals(places), bool_literal(spots.sign > 0), *map(number, numbers), lines, doubts]

    def blanks(self, first: int) -> dict[str, object]:
        """See `SourceCode`."""
        source, oil = self.source, Code("")
        if source.oil is not None:
            values = {
                "place": source.oil.column,
                "low": number(source.oil.low),
                "high": number(source.oil.high),
                "residuals": self.residuals,
                "first": first,
            }
            oil = self.fill_template("flow_oil", values)
        return {
            "oil": oil,
            "length": self.length,
            "spools": len(source.spools.gain),
            "knots": len(KNOTS),
            "reliefs": len(RELIEFS),
            "back": BACK,
            "none": NO_PLACE,
            "smooth": number(SMOOTH),
            "cavity": number(CAVITY),
            "empty": number(EMPTY),
            "doubtful": DOUBTFUL,
            "per_tick": number(source.per_tick),
        }

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        return [f"s->{self.own}_began = false;"]


def _network_bytes(bundle: Bundle) -> int:
    """Return the bytes of the counters and the last inputs.

    Which the state of every network has in addition to what its layers remember.
    """
    return 4 * (8 + len(bundle.inputs))


def _place(column: int) -> int:
    return NO_PLACE if column < 0 else column


def source_code(part: SourcePart, index: int, name: str, columns: Mapping[str, int]) -> SourceCode:
    """Return the code writer for one residual source of a monitor.

    Args:
        part: the source.
        index: its number among the sources.
        name: name of the monitor.
        columns: place of each input of the monitor by its name.

    Raises:
        ExportError: its network has no form in C.
    """
    if isinstance(part, NetworkPart):
        return NetworkCode(part, f"n{index}", f"{name}_n{index}")
    if isinstance(part, TwinPart):
        return TwinCode(part, f"t{index}", f"{name}_t{index}")
    if isinstance(part, FlowBalances):
        return FlowCode(part, f"f{index}", columns)
    return BalanceCode(part, f"b{index}", columns)
