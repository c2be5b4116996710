"""What a page and a command say of the ground under a twin, from the provenance of its run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from edp.wording import listed, percent


def ground_line(provenance: Mapping[str, Any]) -> str:
    """The law of the ground and what it explains, in a sentence; empty where the twin knows free air alone.

    Args:
        provenance: of the run; what is not as `edp twin` wrote it is passed over.
    """
    facts = provenance.get("ground")
    if not isinstance(facts, Mapping):
        return ""
    explained, kind = facts.get("explained"), facts.get("kind")
    parts = explained.items() if isinstance(explained, Mapping) else ()
    shares = [f"{percent(x)} ({part})" for part, x in parts if isinstance(x, float) and math.isfinite(x)]
    name = f"ground '{kind}'" if isinstance(kind, str) else "ground"
    what = listed(shares) or "nothing"
    return f"{name}: explains {what} of the squares of the forces where the tip touches the ground"
