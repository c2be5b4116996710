"""References of file formats, export forms and the C interface, from the registries and the headers themselves."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import edp
from edp.export.base import TARGETS
from edp.logs.formats.base import FORMATS
from edp_site.parts import first_sentence

_COMMENT = re.compile(r"/\*(.*?)\*/", re.DOTALL)
_HEADERS = {
    "edp_runtime.h": "Of every network: statuses, rings, layers, checksums.",
    "edp_integer.h": "In integer arithmetic (W8A16), besides.",
    "edp_tangent.h": "With derivatives (`--set tangent=true`), besides.",
    "edp_adaptation.h": "Of a correction learned on board, besides.",
    "edp_hydraulics.h": "Of a grey box: its equations.",
    "edp_linkage.h": "Of a grey box with a known linkage: its bodies.",
}
"""Headers of the runtime in the order in which a reader meets them."""


def formats_page() -> str:
    """Log formats and export forms, one row each."""
    importlib.import_module("edp.export")  # the folders register what they hold
    importlib.import_module("edp.logs.formats")
    lines = [
        "# Formats",
        "",
        "Made from the code: what is registered. [Recordings](../recordings.md) say what of each format is read.",
        "",
        "## Logs",
        "",
        "| Name | Endings | Content |",
        "|---|---|---|",
    ]
    for name, log_format in FORMATS.items():
        endings = ", ".join(f"`{suffix}`" for suffix in log_format.suffixes)
        lines.append(f"| `{name}` | {endings} | {log_format.content} |")
    lines += ["", "## Exported forms", "", "For `edp export --format NAME`.", "", "| Name | What it is |", "|---|---|"]
    lines += [f"| `{name}` | {first_sentence(target)} |" for name, target in TARGETS.items()]
    return "\n".join(lines) + "\n"


def c_page() -> str:
    """The headers of the exported C: the runtime as it is, and the template of a model's header."""
    root = Path(edp.__path__[0]) / "export" / "c"
    lines = [
        "# C interface",
        "",
        "Made from the headers that an export contains. [Export to C](../export.md) says how to build and call it. "
        "A program calls the functions of its model's header; those of the runtime are what the model itself calls.",
        "",
        "## NAME.h: a model",
        "",
        "The template of the header of an exported model; what stands in braces is filled in from the network.",
        "",
        "```c",
        (root / "templates" / "model.h.in").read_text(encoding="utf-8").rstrip("\n"),
        "```",
    ]
    for name, what in _HEADERS.items():
        text = (root / "runtime" / name).read_text(encoding="utf-8")
        about = " ".join(line.strip(" *") for line in _COMMENT.findall(text)[0].strip().splitlines())
        lines += ["", f"## {name}", "", what, "", f"> {' '.join(about.split())}", "", "```c", text.rstrip("\n"), "```"]
    return "\n".join(lines) + "\n"
