"""A monitor as a package for ROS 2 in Python around the C code: diagnostics out."""

from __future__ import annotations

from pathlib import Path

from edp import __version__
from edp.export.description import as_json
from edp.export.escape import Code, fill_file, markdown_text, package_text, xml_text, yaml_scalar
from edp.export.folder import write_export
from edp.export.monitor.describe import description
from edp.export.monitor.fmu import OUTPUTS
from edp.export.monitor.parts import MonitorParts
from edp.export.monitor.write import monitor_files
from edp.export.ros2.target import message_names, source_guess
from edp.storage.reading import Table

NODE = "monitor"
MODULES = {
    "core.py": "core.py",
    "tick_node.py": "tick_node.py",
    "build.py": "build.py",
    "watch.py": "watch.py",
    "watch_node.py": "node.py",
}
"""Modules of the ROS 2 package and their source files."""


def write_monitor_ros2(parts: MonitorParts, name: str, folder: Path) -> list[Path]:
    """Write a package of a monitor under `folder`, in place of the export that it holds.

    Args:
        parts: its numbers.
        name: name of the monitor; the package is ``NAME_ros``.
        folder: made when absent.

    Raises:
        ExportError: the name or a part cannot be written.
        StorageError: the folder cannot be written.
    """
    package, texts = f"{name}_ros", monitor_files(parts, name).texts()
    about = _describe(parts, name)
    blanks = _blanks(parts, package, name, about)

    def filled(template: str) -> str:
        return fill_file(f"ros2/templates/{template}.in", blanks | {"title": xml_text(parts.title)})

    readme = blanks | {"title": markdown_text(parts.title)}
    evidence = fill_file("monitor/templates/ros2_evidence.c.in", {"name": name, "upper": name.upper()})
    files = {
        "README.md": fill_file("monitor/templates/ros2_README.md.in", readme),
        "package.xml": filled("package.xml"),
        "setup.py": filled("setup.py"),
        "setup.cfg": filled("setup.cfg"),
        f"resource/{package}": "",
        "config/params.yaml": filled("params.yaml"),
        f"launch/{NODE}.launch.py": filled("predictor.launch.py"),
        f"{package}/__init__.py": "",
        f"{package}/model.json": as_json(about).decode(),
        f"{package}/csrc/{name}_ros.c": filled("shim.c") + evidence,
    }
    files |= {f"{package}/{new}": package_text(f"ros2/package/{old}") for old, new in MODULES.items()}
    files |= {f"{package}/csrc/{file}": text for file, text in texts.items()}
    return write_export(folder, {file: text.encode() for file, text in files.items()})


def _describe(parts: MonitorParts, name: str) -> dict[str, object]:
    """Return the description with names valid for parameters and messages, and the outputs as one result."""
    about = description(parts, name)
    names = message_names(entry["name"] for entry in about["inputs"])
    about["inputs"] = [
        entry | {"name": own} | ({} if own == entry["name"] else {"original": entry.get("original", entry["name"])})
        for own, entry in zip(names, about["inputs"], strict=True)
    ]
    about["residuals"] = message_names(parts.residuals)
    outputs = [*(output for output, _ in OUTPUTS), *(f"statistic_{i}" for i in range(len(parts.chain.watches)))]
    result = {"prediction": [1, len(outputs)]}
    targets = [{"name": output} for output in outputs]
    return about | {"outputs": outputs, "targets": targets, "horizons": [{"ticks": 0}], "results": result}


def _blanks(parts: MonitorParts, package: str, name: str, about: Table) -> dict[str, object]:
    names = [entry["name"] for entry in about["inputs"]]
    sources = [
        f"      - {yaml_scalar(f'{own}={source_guess(own, channel.kind)}')}"
        for own, channel in zip(names, parts.inputs, strict=True)
    ]
    return {
        "name": name,
        "node": NODE,
        "package": package,
        "version": __version__,
        "model_hash": parts.digest,
        "rate": float(parts.rate_hz),
        "tick_ms": f"{1000 / parts.rate_hz:g}",
        "sources": Code("\n".join(sources)),
    }
