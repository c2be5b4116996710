"""C code of the on-board adaptation of a model: its constants, and the values for its templates."""

from __future__ import annotations

import numpy as np

from edp.export.c.constants import CConstant, total_bytes
from edp.export.c.text import array, filled, initialiser_rows, number, unsigned_literals
from edp.export.escape import Code
from edp.ir.rls import Adaptation

FILES = ("edp_adaptation.h", "edp_adaptation.c")
POINTERS = ("offset", "scale", "directions", "middle", "spread", "dead_zone", "change", "unit")
NUMBERS = ("keep", "keep_squared", "refresh", "prior", "noise", "limit", "bound", "rate", "worse", "better")

FUNCTIONS = ("edp_adapt_forget", "edp_adapt_directions", "edp_adapt_error", "edp_adapt_due", "edp_adapt_correct")
"""Of the runtime, that every adaptation calls."""
# Bytes of code of ``NAME_adaptation.c`` on a Cortex-M4F, as compiled for 1 to 6 horizons: with one of them the compiler
# leaves the loops out.
OWN_OF_ONE, OWN, OWN_OF_EACH = 720, 930, 28


def own_bytes(adaptation: Adaptation) -> int:
    """Code of ``NAME_adaptation.c``."""
    ahead = len(adaptation.horizons)
    return OWN_OF_ONE if ahead == 1 else OWN + OWN_OF_EACH * ahead


def values(adaptation: Adaptation, upper: str, intervals: int) -> dict[str, object]:
    """Return the template values of an adaptation, which extend the template values of its model.

    Args:
        adaptation: the adaptation.
        upper: name of the model in capitals.
        intervals: number of intervals.
    """
    targets, inputs, n = len(adaptation.columns), len(adaptation.offset), adaptation.features
    row = n + 2 * targets
    work = targets + adaptation.spec.rank + max(inputs, row)
    most = adaptation.unit * adaptation.numbers["limit"]
    sizes = {"inputs": inputs, "targets": targets, "rank": adaptation.spec.rank, "features": n}
    entries = [*POINTERS, "columns", "ahead", *unsigned_literals(sizes.values())]
    entries += [number(adaptation.numbers[name]) for name in NUMBERS]
    rows = [f"    float rows_{k}[{k * row}];" for k in adaptation.horizons]
    return {
        "adaptation_digest": adaptation.digest,
        # The lowest bit makes the marker odd: cleared memory, all zeros, never passes for a state that was reset.
        "adapt_marker": int(adaptation.digest[:8], 16) | 1,
        "ahead": ", ".join(map(str, adaptation.horizons)),
        "adapt_ahead": ", ".join(unsigned_literals(adaptation.horizons)),
        "reach": adaptation.max_horizon,
        "rank": adaptation.spec.rank,
        "features": n,
        "forgetting": f"{adaptation.spec.forgetting_s:g}",
        "judged": f"{adaptation.spec.evaluation_s:g}",
        "margin": f"{100 * adaptation.spec.margin:g}",
        "adapt_macs": adaptation.macs,
        "adapt_flash": total_bytes(constants(adaptation)),
        "adapt_ram": 4 * (5 + len(adaptation.horizons) + adaptation.state_numbers + work),
        "adapt_rows": Code("\n".join(rows)),
        "adapt_pointers": Code(", ".join(f"a->rows_{k}" for k in adaptation.horizons)),
        "adapt_work": work,
        "adapt_constants": Code("\n".join(one.text for one in constants(adaptation) if one.text)),
        "adapt_law": filled(entries),
        "adapt_most": initialiser_rows(map(number, row) for row in most),
        "adapt_intervals": _intervals(upper) if intervals else "",
    }


def constants(adaptation: Adaptation) -> list[CConstant]:
    """Return all constants; constants with text are in the order of the C code."""
    lines = []
    for name in POINTERS:
        values = np.atleast_1d(getattr(adaptation, name)).ravel()
        # C has no array of nothing: without directions one number stands there that is never read.
        numbers = values if values.size else np.zeros(1)
        lines.append(CConstant("float", name, len(numbers), array("float", name, map(number, numbers))))
    columns = array("uint16_t", "columns", unsigned_literals(adaptation.columns))
    lines.append(CConstant("uint16_t", "columns", len(adaptation.columns), columns))
    shared = [CConstant("edp_adapt_law", "law", 1), CConstant("float", "adapt_most", adaptation.unit.size)]
    return [*lines, *shared, CConstant("uint32_t", "ahead", len(adaptation.horizons))]


def _intervals(upper: str) -> Code:
    """Return the bounds of intervals move with the prediction."""
    # Bounds move with the prediction, so that the interval keeps its width.
    lines = [f"for (uint32_t i = 0; i < {upper}_INTERVALS; i++) {{"]
    for bound in ("lower", "upper"):
        lines.append(f"    adapted->{bound}[i][h][j] = out->{bound}[i][h][j] + correction[j];")
    return Code("\n".join(" " * 16 + line for line in [*lines, "}"]))
