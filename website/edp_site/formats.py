"""Reference of log formats, export formats and the C interface, from the registries and the headers."""

from __future__ import annotations

import importlib
import re
from pathlib import Path

import edp
from edp.export.base import TARGETS
from edp.logs.formats.base import FORMATS
from edp.logs.formats.mat_layouts import LAYOUTS
from edp_site.parts import first_sentence, options

_COMMENT = re.compile(r"/\*(.*?)\*/", re.DOTALL)
_HEADERS = {
    "edp_runtime.h": "Every network uses it: statuses, ring buffers, layers, checksums.",
    "edp_integer.h": "Networks in integer arithmetic (W8A16) use it in addition.",
    "edp_tangent.h": "Networks with derivatives (`--set tangent=true`) use it in addition.",
    "edp_adaptation.h": "Networks with an on-board adaptation use it in addition.",
    "edp_hydraulics.h": "Grey boxes use it: their equations.",
    "edp_linkage.h": "Grey boxes with a known linkage use it: their rigid bodies.",
}
"""Headers of the runtime in the order in which a reader meets them."""


def formats_page() -> str:
    """Describe log formats, MAT layouts and export formats, one row each."""
    importlib.import_module("edp.export")  # the folders register what they hold
    importlib.import_module("edp.logs.formats")
    lines = ["## Log formats", "", "| Name | File endings | Content |", "|---|---|---|"]
    for name, log_format in FORMATS.items():
        endings = ", ".join(f"`{suffix}`" for suffix in log_format.suffixes)
        lines.append(f"| `{name}` | {endings} | {log_format.content} |")
    layouts = ", ".join(f"`{name}`" for name in LAYOUTS)
    lines += ["", f"Layouts of MAT files: {layouts}."]
    lines += ["", "## Export formats", "", "| Name | Options and their defaults | Files |", "|---|---|---|"]
    lines += [f"| `{name}` | {options(target)} | {first_sentence(target)} |" for name, target in TARGETS.items()]
    return "\n".join(lines) + "\n"


def c_page() -> str:
    """Show the headers of the exported C: the template of a model's header, then the runtime."""
    root = Path(edp.__path__[0]) / "export" / "c"
    lines = [
        "## NAME.h: a model",
        "",
        "Template of the header of an exported model. The export replaces the names in braces.",
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
