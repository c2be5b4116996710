"""C header with the positions of the grey-box parameters, written from the Python module that defines them."""

from __future__ import annotations

import inspect
import re
import textwrap

from edp.export.c.text import WIDTH, filled
from edp.networks.twin.grey import parameter_index

HEADER = "edp_parameter_index.h"
TIED = "\N{NO-BREAK SPACE}"
PYTHON_ONLY = re.compile(r"BY_\w+|OWN|NONE")
"""Pattern for the names of derivatives that only Python computes."""


def index_header() -> str:
    """Return the header: an enumeration for each paragraph of the module, under the comment of the paragraph."""
    parts = ["/* Positions of the parameters of a grey box. Written by EDP; do not edit. */"]
    parts += ["#ifndef EDP_PARAMETER_INDEX_H", "#define EDP_PARAMETER_INDEX_H", ""]
    written: set[str] = set()
    for paragraph in inspect.getsource(parameter_index).split("\n\n"):
        lines = paragraph.splitlines()
        comment = " ".join(line.removeprefix("# ") for line in lines if line.startswith("#"))
        code = " ".join(line for line in lines if not line.startswith("#"))
        positions = {name: getattr(parameter_index, name, None) for name in re.findall(r"\b[A-Z]\w+", code)}
        own = {
            name: position
            for name, position in positions.items()
            if isinstance(position, int) and name not in written and not PYTHON_ONLY.fullmatch(name)
        }
        if own:
            parts += textwrap.wrap(f"/* {comment} */", WIDTH, subsequent_indent="   ") if comment else []
            # Lines break between entries, not within one.
            entries = filled(f"{name}{TIED}={TIED}{position}" for name, position in own.items())
            parts += ["enum {", entries.replace(TIED, " "), "};"]
            written |= set(own)
    return "\n".join([*parts, "", "#endif", ""])
