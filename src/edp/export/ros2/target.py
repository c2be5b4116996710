"""``--format ros2``: a package for ROS 2 in Python around the C code, float32 or w8a16."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from edp import __version__
from edp.export.base import TARGETS
from edp.export.c.model import Model, make_model
from edp.export.c.target import check_name, core_files
from edp.export.description import Description, as_json
from edp.export.escape import Code, fill, markdown_text, shown_names, xml_text, yaml_scalar
from edp.export.folder import write_export
from edp.export.hashes import model_hash
from edp.signals import Kind
from edp.storage.reading import Table
from edp.training.bundle import Bundle

MODULES = ("core.py", "node.py", "tick_node.py", "replay.py", "build.py")
JOINTS = {
    Kind.VELOCITY: "velocity",
    Kind.ANGULAR_VELOCITY: "velocity",
    Kind.POSITION: "position",
    Kind.ANGLE: "position",
}
FREE = "constant:0"
"""Source of a plant's flag: its input port uses the last prediction."""
PRESSURES = (Kind.PRESSURE, Kind.PILOT_PRESSURE)


@TARGETS.register("ros2")
@dataclass(frozen=True)
class Ros2Target:
    """ROS 2 (ament_python): a node with launch file and parameters around the C code, replay of bags without ROS."""

    def write(self, bundle: Bundle, name: str, folder: Path) -> list[Path]:
        """See `edp.export.ExportTarget`."""
        check_name(name)
        model = make_model(name, bundle)
        package = f"{name}_ros"
        here = resources.files("edp.export.ros2")
        about = _content(Description(name, bundle, model.graph))
        blanks = _blanks(model, package, about)

        def filled(template: str) -> str:
            title = bundle.predictor.title
            escaped = {"title": (markdown_text if template.endswith(".md") else xml_text)(title)}
            return fill(here.joinpath(f"templates/{template}.in").read_text(), blanks | escaped)

        files = {
            "README.md": filled("README.md"),
            "package.xml": filled("package.xml"),
            "setup.py": filled("setup.py"),
            "setup.cfg": filled("setup.cfg"),
            f"resource/{package}": "",
            "config/params.yaml": filled("params.yaml"),
            "launch/predictor.launch.py": filled("predictor.launch.py"),
            f"{package}/__init__.py": "",
            f"{package}/model.json": as_json(about).decode(),
            f"{package}/csrc/{name}_ros.c": filled("shim.c"),
        }
        files |= {f"{package}/{file}": here.joinpath(f"package/{file}").read_text() for file in MODULES}
        files |= {f"{package}/csrc/{file}": text for file, text in core_files(model).items()}
        return write_export(folder, {file: text.encode() for file, text in files.items()})


def _content(described: Description) -> dict[str, object]:
    """Return the description with names valid for parameters and messages.

    They are `shown_names` without ``=``, which ends the name in a parameter, and do not begin as a formula of a
    spreadsheet does; a name that was replaced is kept as ``original``.
    """
    about = described.content()
    for side in ("inputs", "targets"):
        channel_names = [entry["name"] for entry in about[side]]
        names = message_names(channel_names)
        about[side] = [
            entry | {"name": name} | ({} if name == old else {"original": entry.get("original", old)})
            for entry, name, old in zip(about[side], names, channel_names, strict=True)
        ]
    return about


def message_names(names: Iterable[str]) -> list[str]:
    """Return the names that fit into parameters and messages; see `_content`."""
    return shown_names(_plain(name) for name in names)


def _plain(name: str) -> str:
    # Equal signs separate name and source in a parameter.
    plain = name.replace("=", "_")
    return f"_{plain}" if plain.startswith(("+", "-", "@")) else plain


def _blanks(model: Model, package: str, about: Table) -> dict[str, object]:
    task, inputs = model.bundle.task, [entry["name"] for entry in about["inputs"]]
    # Behind the measured values of a plant are their flags.
    read = len(inputs) if not model.graph.fed_back else model.bundle.predictor.required + len(task.targets)
    sources = [
        f"      - {yaml_scalar(f'{name}={source_guess(name, channel.kind) if at < read else FREE}')}"
        for at, (name, channel) in enumerate(zip(inputs, model.bundle.inputs, strict=True))
    ]
    return {
        "name": model.name,
        "package": package,
        "node": "predictor",
        "version": __version__,
        "model_hash": model_hash(model.graph),
        "rate": float(task.rate_hz),
        "tick_ms": f"{1000 / task.rate_hz:g}",
        "targets": Code(", ".join(markdown_text(entry["name"]) for entry in about["targets"])),
        "sources": Code("\n".join(sources)),
    }


def source_guess(name: str, kind: Kind) -> str:
    """Return the source proposed in the parameter file."""
    # Pressures have no field in a message of joints.
    if kind in PRESSURES:
        return f"pressure:{name}"
    return f"{JOINTS.get(kind, 'effort')}:{name}"
