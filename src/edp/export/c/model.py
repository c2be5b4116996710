"""Header, source and constants of a model as C text, from its graph, inputs and outputs."""

from __future__ import annotations

import binascii
from dataclasses import dataclass

from edp import __version__
from edp.errors import ExportError
from edp.export.c import adaptation, integer_calls, parameter_index, tangents
from edp.export.c.calls import WORK, Calls, describe, needs_columns, slot
from edp.export.c.constants import constants_of, stored, total_bytes
from edp.export.c.plan import MemoryPlan, plan
from edp.export.c.text import channel_enumeration, enumeration, filled, indented, number
from edp.export.escape import C_SIGNIFICANT, Code, c_comment, fill_file, package_text
from edp.export.hashes import little_endian, model_hash, scale_hash
from edp.export.si_names import si_names
from edp.export.sizes import MAX_COLUMNS, check_numbers, check_sizes
from edp.ir import Graph, Layer
from edp.ir.base import Number
from edp.ir.hydraulics import HydraulicTick
from edp.networks.input_range import HOLD_TICKS, LIMIT, input_limits
from edp.networks.integer import IntegerPredictor
from edp.signals import KINDS
from edp.training.bundle import Bundle

RUNTIME = ("edp_runtime.h", "edp_runtime.c", "edp_memory.c")
HYDRAULICS = ("edp_hydraulics.h", "edp_linkage.h", "edp_hydraulics.c", "edp_linkage.c")
DOUBLE_BYTES = 8
MAX_STACK = 2**18
"""Maximum stack size in bytes: a quarter of the smallest default thread stack of desktop systems (1 MiB, Windows)."""
CLIPPED = Code("    uint32_t clipped;  /* numbers beyond the range of their format, chosen on training data */\n")
PLANT = (
    " *",
    " * PLANT MODEL. Inputs are the commands, a measured value for each answer, and a flag for each (..._MEASURED): 1",
    " * reads the measured value, 0 the model's own last answer. With all flags at 0 it runs free on the commands;",
    " * a value that nobody reads must be finite, such as 0. Start with {ticks} measured ticks, which form its memory;",
    " * without any it rests at the means of its training data. The state has no pointers: its copy is a saved state.",
)
"""Header lines of a plant model."""
COST = """\
 * COST PER TICK. {macs} multiply-accumulates; the number of operations is the same at every tick, up to {hold}
 * times that in {name}_missed. Constants {flash} bytes on a 32-bit
 * controller, state {ram} bytes."""
EQUATIONS_COST = """\
 * COST PER TICK. Its equations are solved by Newton's method in double precision, so THE TIME OF A TICK VARIES:
 * an iteration of all stages has {macs} multiply-accumulates for linear equations alone, and a stage may need
 * EDP_MOST_ITERATIONS of them; up to {hold} times that in {name}_missed. Constants {flash} bytes on a
 * 32-bit controller, state {ram} bytes, and {stack} bytes of stack in which a tick works."""
"""Header lines on the computing time per sample, for networks with equations and for grey boxes."""
STATES = {Number.FLOAT: "float", Number.INT16: "int16_t", Number.INT32: "int32_t"}
FILLS = {Number.FLOAT: "edp_fill(0.0f, ", Number.INT16: "edp_q_zero16(", Number.INT32: "edp_q_fill32(0, "}
COPIES = {Number.FLOAT: "edp_copy", Number.INT16: "edp_q_copy16", Number.INT32: "edp_q_copy32"}


@dataclass(frozen=True, eq=False)
class Model:
    """Template values of one model.

    Attributes:
        name: C prefix of the model.
        bundle: the trained network.
        graph: its layers.
        plan: places in the work memory.
        changes: places of their changes, where the model has tangents.
        adapts: whether the bundle's adaptation is written beside it.
    """

    name: str
    bundle: Bundle
    graph: Graph
    plan: MemoryPlan
    changes: MemoryPlan | None = None
    adapts: bool = False

    @property
    def integer(self) -> bool:
        """Whether the model computes in integer arithmetic."""
        return isinstance(self.bundle.predictor, IntegerPredictor)

    @property
    def hydraulic(self) -> bool:
        """Whether a layer is a grey box."""
        return any(isinstance(layer, HydraulicTick) for layer in self.graph.layers)

    @property
    def runtime(self) -> tuple[str, ...]:
        """Files of the runtime that it needs."""
        more: tuple[str, ...] = integer_calls.FILES if self.integer else ()
        more += HYDRAULICS if self.hydraulic else ()
        more += () if self.changes is None else tangents.FILES
        return RUNTIME + more + (adaptation.FILES if self.adapts else ())

    @property
    def sources(self) -> tuple[str, ...]:
        """C files that a program with this model compiles."""
        own: tuple[str, ...] = (f"{self.name}.c",)
        own += () if self.changes is None else (f"{self.name}_tangent.c",)
        own += (f"{self.name}_adaptation.c",) if self.adapts else ()
        return own + tuple(name for name in self.runtime if name.endswith(".c"))

    @property
    def _header(self) -> str:
        """Header of the runtime that includes all others which it needs."""
        return "edp_integer.h" if self.integer else (HYDRAULICS[0] if self.hydraulic else RUNTIME[0])

    def weights(self) -> str:
        """Return the file of constants."""
        parts = [f"/* Constants of {self.name}. Written by EDP {__version__}; do not edit. */"]
        parts += [one.text for one in constants_of(self.graph, self.plan, written=True) if one.text]
        return "\n".join(parts) + "\n"

    def fill(self, template: str) -> Code:
        """Fill in a template."""
        return fill_file(f"c/templates/{template}", self._values())

    def runtime_texts(self) -> dict[str, str]:
        """Return the files of the runtime by name, generated tables first."""
        texts = {"edp_tables.h": integer_calls.tables_header()} if self.integer else {}
        texts |= {parameter_index.HEADER: parameter_index.index_header()} if self.hydraulic else {}
        return texts | {file: package_text(f"c/runtime/{file}") for file in self.runtime}

    def _values(self) -> dict[str, object]:
        task, predictor = self.bundle.task, self.bundle.predictor
        low, high = input_limits(predictor)
        return {
            "name": self.name,
            "NAME": self.name.upper(),
            "title": c_comment(predictor.title),
            "version": __version__,
            "model_hash": model_hash(self.graph),
            "scale_hash": scale_hash(predictor),
            # Odd for the same reason: zeroed memory must not look like a state that was reset.
            "marker": int(model_hash(self.graph)[:8], 16) | 1,
            "crc": crc(self.graph),
            "inputs": self.graph.inputs,
            "horizons": len(task.horizons),
            "targets": len(task.targets),
            "intervals": len(predictor.output.coverages),
            "rate": number(task.rate_hz),
            "tick_ms": f"{1000 / task.rate_hz:g}",
            "window": self.graph.window,
            "hold": HOLD_TICKS,
            "limit": f"{LIMIT:.0f}",
            "format": self.bundle.predictor.number_format,
            "runtime": self._header,
            "counters": CLIPPED if self.integer else "",
            "clear_counters": Code("    s->clipped = 0u;\n") if self.integer else "",
            "sources": " ".join(self.sources),
            "low": filled(map(number, low)),
            "high": filled(map(number, high)),
            "what": self._what(),
            "cost": self._cost(),
            **self._enums(),
            **self._state(),
            **self._work(),
            **self._code(),
            **({} if self.changes is None else self._tangent(self.changes)),
            **self._adaptation(),
        }

    def _what(self) -> Code:
        task = self.bundle.task
        when = ", ".join(f"{k} ticks ({1000 * k / task.rate_hz:g} ms)" for k in task.horizons)
        units = [KINDS[kind].si_unit for kind in self.bundle.target_kinds]
        targets = ", ".join(c_comment(f"{name} [{unit}]") for name, unit in zip(self._targets(), units, strict=True))
        lines = [f" *   prediction[h][t]  {targets}, for each of {when} ahead"]
        covered = ", ".join(f"{100 * c:g} %" for c in self.bundle.predictor.output.coverages)
        if covered:
            lines.append(f" *   lower, upper[i][h][t]  bounds of intervals meant to hold {covered} of the true values")
        if self.graph.fed_back:
            lines += [line.format(ticks=self.graph.window) for line in PLANT]
        return Code("\n".join(lines))

    def _targets(self) -> list[str]:
        return si_names(self.bundle.task.targets, self.bundle.target_kinds)

    def _cost(self) -> Code:
        text = EQUATIONS_COST if self.hydraulic else COST
        room = max((layer.room for layer in self.graph.layers if isinstance(layer, HydraulicTick)), default=0)
        facts = {"macs": self.graph.macs, "ram": self.state_bytes(), "stack": DOUBLE_BYTES * room}
        flash = total_bytes(constants_of(self.graph, self.plan))
        return Code(text.format(**facts, flash=flash, name=self.name, hold=f"{self.name.upper()}_HOLD_TICKS"))

    def _enums(self) -> dict[str, str]:
        task, upper = self.bundle.task, self.name.upper()
        # Names must differ within the 63 characters that C99 compares.
        longest = C_SIGNIFICANT - len(f"{upper}_OUT_")
        units = [KINDS[kind].si_unit for kind in self.bundle.target_kinds]
        meanings = ["; ".join(filter(None, pair)) for pair in zip(units, self.bundle.descriptions, strict=True)]
        ahead = [f"{k} ticks, {1000 * k / task.rate_hz:g} ms" for k in task.horizons]
        return {
            "input_enum": channel_enumeration(f"{upper}_IN_", self.bundle.inputs, longest, aligned=True),
            "target_enum": enumeration(f"{upper}_OUT_", self._targets(), meanings, longest, aligned=True),
            "horizon_enum": enumeration(f"{upper}_AHEAD_", map(str, task.horizons), ahead, aligned=True),
        }

    def _state(self) -> dict[str, str]:
        declared, cleared = remembered(self.graph)
        return {"state_fields": indented(declared), "forget": indented(cleared)}

    def _work(self) -> dict[str, str]:
        sizes = self.plan.sizes
        return {
            "work_fields": indented(f"{STATES[kind]} {WORK[kind]}[{size}];" for kind, size in sizes.items()),
            "work_pointers": indented(f"{STATES[kind]} *const {WORK[kind]} = s->{WORK[kind]};" for kind in sizes),
            "clear_work": indented(clear_work(self.plan)),
        }

    def _tangent(self, changes: MemoryPlan) -> dict[str, object]:
        # Ages are counts, through which nothing is differentiated.
        parts = [(layer, part) for layer, part in self.graph.slots() if part.name != "age"]
        calls, work = tangents.Tangents(self.graph, self.plan, changes), changes.sizes[Number.FLOAT]
        lines = [line for layer in self.graph.layers for line in ("", describe(layer), *calls.translate(layer))]
        fields = [(tangents.changed(name, part.name), max(1, part.size)) for name, part in parts]
        copies = []
        for meaning, value in self.graph.results.items():
            first = "[0][0]" if meaning == "prediction" else "[0][0][0]"
            target = calls.change(value).replace("t->", "t[k].")
            copies.append(f"edp_copy({target}, {self.graph.width_of(value)}u, &dout[k].{meaning}{first});")
        return {
            "tangent_fields": indented(f"float {field.removeprefix('t->')}[{size}];" for field, size in fields),
            "tangent_forget": indented(f"edp_fill(0.0f, {size}u, {field});" for field, size in fields),
            "tangent_work": work,
            "tangent_ram": 4 * (self.graph.inputs + sum(size for _, size in fields) + work),
            "tangent_compute": indented(lines[1:]),
            "tangent_copies": indented(copies, " " * 12),
        }

    def _adaptation(self) -> dict[str, object]:
        law = self.bundle.adaptation
        if not self.adapts or law is None:
            return {}
        return adaptation.values(law, self.name.upper(), len(self.bundle.predictor.output.coverages))

    def state_bytes(self) -> int:
        """Size of the state, without padding by the compiler."""
        slots = sum(max(1, part.size) * part.number.bytes for _, part in self.graph.slots() if part.name != "age")
        rings = sum(has_ring(layer) for layer in self.graph.layers)
        work = sum(size * kind.bytes for kind, size in self.plan.sizes.items())
        # Seven words: counters, marker, age and holding; rings have a place and a count.
        return 4 * (7 + self.integer + self.graph.inputs + 2 * rings) + slots + work

    def _code(self) -> dict[str, str]:
        members = []
        shape = "[{0}_HORIZONS][{0}_TARGETS]".format(self.name.upper())
        for meaning in self.graph.results:
            more = "" if meaning == "prediction" else f"[{self.name.upper()}_INTERVALS]"
            members.append(f"float {meaning}{more}{shape};")
        compute, finish = computed(self.graph, self.plan)
        return {"compute": indented(compute), "finish": indented(finish), "output_fields": indented(members)}


def remembered(graph: Graph) -> tuple[list[str], list[str]]:
    """Return the fields of the state, and the statements that set them after a reset."""
    declared, cleared = [], []
    for layer in graph.layers:
        for part in layer.slots:
            if part.name == "age":
                continue
            # C has no array without elements.
            where, size = slot(layer, part.name), max(1, part.size)
            field = where.removeprefix("s->")
            declared.append(f"{STATES[part.number]} {field}[{size}];")
            learned = (layer.name, part.name) in graph.initial
            start = f"{COPIES[part.number]}({field}_start, {size}u, {where});"
            zero = f"{FILLS[part.number]}{size}u, {where});"
            value = f"edp_fill({number(part.fill)}, {size}u, {where});" if part.fill else zero
            cleared.append(start if learned else value)
        if has_ring(layer):
            field = slot(layer, "ring_at").removeprefix("s->")
            declared.append(f"edp_ring {field};")
            cleared += [f"s->{field}.at = 0u;", f"s->{field}.seen = 0u;"]
    return declared, cleared


def clear_work(plan: MemoryPlan) -> list[str]:
    """Return the statements that clear the work memories."""
    return [f"{FILLS[kind]}{size}u, s->{WORK[kind]});" for kind, size in plan.sizes.items()]


def computed(graph: Graph, plan: MemoryPlan) -> tuple[list[str], list[str]]:
    """Return the statements of a tick: the layers one after the other, and what becomes of the results."""
    calls = Calls(graph, plan)
    lines = [line for layer in graph.layers for line in ("", describe(layer), *calls.translate(layer))]
    checks: list[str] = []
    copies = []
    for meaning, value in graph.results.items():
        size, at = graph.width_of(value), calls.value(value)
        first = f"edp_all_finite({at}, {size}u)"
        # The check of each result comes first in `&&`, so that every one of them is looked at.
        checks.append(f"finite = {first} && finite;" if checks else f"bool finite = {first};")
        zero = "[0][0]" if meaning == "prediction" else "[0][0][0]"
        copies.append(f"    edp_copy({at}, {size}u, &out->{meaning}{zero});")
    return lines[1:], [*checks, "if (finite) {", *copies, "}", "return finite;"]


def make_model(name: str, bundle: Bundle, tangent: bool = False, adapts: bool = False) -> Model:
    """Create a model ready to be written.

    Args:
        name: C prefix of the model.
        bundle: the trained network.
        tangent: whether to include tangents.
        adapts: whether to include the bundle's adaptation, if there is one.

    Raises:
        ExportError: a part of the network has no form as a layer, a tangent of integers is asked for, or a size is
            beyond the numbers of C.
    """
    predictor = bundle.predictor
    integer = isinstance(predictor, IntegerPredictor)
    if integer and tangent:
        raise ExportError("a network in integer arithmetic is a staircase and has no tangent; export the float run")
    graph = predictor.integers if isinstance(predictor, IntegerPredictor) else predictor.graph()
    changes = plan(graph, tangent=True) if tangent else None
    model = Model(name, bundle, graph, plan(graph), changes, adapts and bundle.adaptation is not None)
    _check(model)
    return model


def _check(model: Model) -> None:
    """Refuse sizes that the C code cannot represent.

    Raises:
        ExportError: a size is beyond the numbers of the generated code.
    """
    graph, law = model.graph, model.bundle.adaptation
    check_numbers(model.bundle)
    # Windows and ticks are 32-bit counts in C.
    layers = {f"ticks that '{x.name}' remembers": getattr(x, "window", getattr(x, "ticks", 0)) for x in graph.layers}
    constants = sum(values.nbytes for _, _, values in graph.tensors())
    check_sizes({"window": graph.window, "bytes of constants": constants, "bytes of the state": model.state_bytes()})
    check_sizes(layers)
    for layer in graph.layers:
        stack = DOUBLE_BYTES * layer.room if isinstance(layer, HydraulicTick) else 0
        if stack > MAX_STACK:
            raise ExportError(
                f"a tick of layer '{layer.name}' works in {stack:,} bytes of stack; at most {MAX_STACK:,} must hold: "
                "train with fewer cylinders, or with a smaller twin.inertia_degree or twin.potential_degree"
            )
    calls = Calls(graph, model.plan)
    chosen = {x.name: max(x.columns) + 1 for x in graph.layers if needs_columns(calls, x)}  # type: ignore[attr-defined]
    check_sizes({f"numbers that '{name}' chooses from": size for name, size in chosen.items()}, MAX_COLUMNS)
    if model.adapts and law is not None:
        sizes = {"bytes of the adaptation's memory": 4 * law.state_numbers, "its horizons": max(law.horizons)}
        check_sizes(sizes)
        check_sizes({"inputs from which its targets are read": int(max(law.columns)) + 1}, MAX_COLUMNS)


def has_ring(layer: Layer) -> bool:
    """Return whether the C state of a layer has a ring or a counter."""
    return layer.counted and bool(layer.slots)


def crc(graph: Graph) -> int:
    """Return the CRC-32 of all constants, little-endian, in the order of the C code."""
    value = 0
    for layer in graph.layers:
        for name, values in layer.tensors().items():
            value = binascii.crc32(little_endian(stored(layer, name, values)), value)
    return value
