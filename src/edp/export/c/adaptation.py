"""The on-board adaptation of a model as text: its constants, and what its templates are filled with."""

from __future__ import annotations

import numpy as np

from edp.export.c.constants import CConstant, total_bytes
from edp.export.c.text import array, filled, number
from edp.export.escape import Code
from edp.ir.rls import Adaptation

FILES = ("edp_adaptation.h", "edp_adaptation.c")
POINTERS = ("offset", "scale", "directions", "middle", "spread", "rest", "change", "unit")
NUMBERS = ("keep", "keep_squared", "refresh", "prior", "noise", "limit", "bound", "rate", "worse", "better")

FUNCTIONS = ("edp_adapt_forget", "edp_adapt_directions", "edp_adapt_error", "edp_adapt_due", "edp_adapt_correct")
"""Of the runtime, that every adaptation calls."""
# Bytes of code of ``NAME_adaptation.c`` on a Cortex-M4F, as compiled for 1 to 6 horizons: with one of them the compiler
# leaves the loops out.
OWN_OF_ONE, OWN, OWN_OF_EACH = 720, 930, 28


def own_bytes(law: Adaptation) -> int:
    """Code of ``NAME_adaptation.c``."""
    ahead = len(law.horizons)
    return OWN_OF_ONE if ahead == 1 else OWN + OWN_OF_EACH * ahead


def values(law: Adaptation, upper: str, intervals: int) -> dict[str, object]:
    """What the templates of an adaptation are filled with besides what its model gives.

    Args:
        law: the adaptation.
        upper: name of the model in capitals.
        intervals: how many it states.
    """
    targets, inputs, n = len(law.columns), len(law.offset), law.features
    row = n + 2 * targets
    work = targets + law.spec.rank + max(inputs, row)
    most = law.unit * law.numbers["limit"]
    sizes = {"inputs": inputs, "targets": targets, "rank": law.spec.rank, "features": n}
    entries = [*POINTERS, "columns", "ahead", *(f"{size}u" for size in sizes.values())]
    entries += [number(law.numbers[name]) for name in NUMBERS]
    rows = [f"    float rows_{k}[{k * row}];" for k in law.horizons]
    return {
        "adaptation_digest": law.digest,
        "adapt_marker": int(law.digest[:8], 16) | 1,
        "ahead": ", ".join(map(str, law.horizons)),
        "adapt_ahead": ", ".join(f"{k}u" for k in law.horizons),
        "reach": law.reach,
        "rank": law.spec.rank,
        "features": n,
        "forgetting": f"{law.spec.forgetting_s:g}",
        "judged": f"{law.spec.judged_s:g}",
        "margin": f"{100 * law.spec.margin:g}",
        "adapt_macs": law.macs,
        "adapt_flash": total_bytes(constants(law)),
        "adapt_ram": 4 * (5 + len(law.horizons) + law.state_numbers + work),
        "adapt_rows": Code("\n".join(rows)),
        "adapt_pointers": Code(", ".join(f"a->rows_{k}" for k in law.horizons)),
        "adapt_work": work,
        "adapt_constants": Code("\n".join(one.text for one in constants(law) if one.text)),
        "adapt_law": filled(entries),
        "adapt_most": Code(",\n".join(f"    {{{', '.join(map(number, of))}}}" for of in most)),
        "adapt_intervals": _intervals(upper) if intervals else "",
    }


def constants(law: Adaptation) -> list[CConstant]:
    """All constants, those with a text in the order of the C code."""
    lines = []
    for name in POINTERS:
        values = np.atleast_1d(getattr(law, name)).ravel()
        # C has no array of nothing: without directions one number stands there that is never read.
        numbers = values if values.size else np.zeros(1)
        lines.append(CConstant("float", name, len(numbers), array("float", name, map(number, numbers))))
    columns = array("uint16_t", "columns", (f"{column}u" for column in law.columns))
    lines.append(CConstant("uint16_t", "columns", len(law.columns), columns))
    shared = [CConstant("edp_adapt_law", "law", 1), CConstant("float", "adapt_most", law.unit.size)]
    return [*lines, *shared, CConstant("uint32_t", "ahead", len(law.horizons))]


def _intervals(upper: str) -> Code:
    """Bounds of intervals move with the prediction."""
    lines = [f"for (uint32_t i = 0; i < {upper}_INTERVALS; i++) {{"]
    for bound in ("lower", "upper"):
        lines.append(f"    adapted->{bound}[i][h][j] = out->{bound}[i][h][j] + correction[j];")
    return Code("\n".join(" " * 16 + line for line in [*lines, "}"]))
