"""Memory of a model and its program on a controller, computed from its layers; every command reports these values.

`constant_bytes` counts what the C code declares, so it is what a compiler makes of it, to the byte; `program_bytes`
adds up measured functions and is within 2 % of what is linked.
"""

from __future__ import annotations

from dataclasses import dataclass

from edp.export.c import adaptation as adapting
from edp.export.c.constants import CORTEX_M, DataModel, constants_of, total_bytes
from edp.export.c.model import clear_work, computed, remembered
from edp.export.c.plan import plan
from edp.export.c.program import FIXED, MAX_COPIED, called, own_bytes, runtime_bytes
from edp.ir import Graph
from edp.ir.rls import Adaptation


@dataclass(frozen=True)
class Sizes:
    """Bytes of read-only memory, on a 32-bit Arm core.

    Attributes:
        constants: everything that belongs to the model: weights, multipliers, shifts, biases, limits of the inputs,
            what says where they are, and gaps up to the next word.
        program: code, and the tables of functions that all models share.
    """

    constants: int
    program: int


def sizes_of(graph: Graph, adaptation: Adaptation | None = None) -> Sizes:
    """Return the sizes of the C code of a graph, with its adaptation.

    Raises:
        ExportError: a layer has no C function.
    """
    return Sizes(constant_bytes(graph, adaptation), program_bytes(graph, adaptation))


def constant_bytes(graph: Graph, adaptation: Adaptation | None = None, machine: DataModel = CORTEX_M) -> int:
    """Return the size of the constants in the C code of a model, with its adaptation.

    Args:
        graph: its layers.
        adaptation: adaptation of the run, if there is one.
        machine: target machine.
    """
    more = [] if adaptation is None else adapting.constants(adaptation)
    return total_bytes(constants_of(graph, plan(graph)), machine) + total_bytes(more, machine)


def program_bytes(graph: Graph, adaptation: Adaptation | None = None) -> int:
    """Code of a model and of the runtime's functions that it needs, with their tables, on a Cortex-M4F.

    Raises:
        ExportError: a layer has no C function.
    """
    places = plan(graph)
    compute, finish = computed(graph, places)
    statements = [*compute, *finish, *remembered(graph)[1]]
    functions = {*FIXED, *called(statements), *called(clear_work(places))}
    # The output is copied as a struct; beyond `MAX_COPIED` the compiler calls `memcpy`.
    copied = 4 * sum(map(graph.width_of, graph.results.values()))
    own = own_bytes(statements)
    if adaptation is not None:
        own += adapting.own_bytes(adaptation)
        functions |= set(adapting.FUNCTIONS)
        copied = max(copied, 4 * (1 + adaptation.unit.size * adaptation.features))
    if copied > MAX_COPIED:
        functions.add("memcpy")
    return own + runtime_bytes(functions)
