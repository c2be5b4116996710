"""``--to ros2``: a package for ROS 2 in Python around the C code, float32 or w8a16."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from string import Template
from xml.sax.saxutils import escape

from edp import __version__
from edp.export.base import TARGETS
from edp.export.c.model import Model, make_model
from edp.export.c.target import check_name, core_files
from edp.export.description import Description, as_json
from edp.export.hashes import model_hash
from edp.models.predictor import describe as describe_network
from edp.signals import Kind
from edp.storage import make_folder, write_bytes
from edp.training.bundle import Bundle

MODULES = ("core.py", "node.py", "replay.py", "build.py")
JOINTS = {
    Kind.VELOCITY: "velocity",
    Kind.ANGULAR_VELOCITY: "velocity",
    Kind.POSITION: "position",
    Kind.ANGLE: "position",
}
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
        blanks = _blanks(model, package)

        def fill(template: str) -> str:
            return Template(here.joinpath(f"templates/{template}.in").read_text()).substitute(blanks)

        made = {
            "README.md": fill("README.md"),
            "package.xml": fill("package.xml"),
            "setup.py": fill("setup.py"),
            "setup.cfg": fill("setup.cfg"),
            f"resource/{package}": "",
            "config/params.yaml": fill("params.yaml"),
            "launch/predictor.launch.py": fill("predictor.launch.py"),
            f"{package}/__init__.py": "",
            f"{package}/model.json": as_json(Description(name, bundle, model.graph).content()).decode(),
            f"{package}/csrc/{name}_ros.c": fill("shim.c"),
        }
        made |= {f"{package}/{file}": here.joinpath(f"package/{file}").read_text() for file in MODULES}
        made |= {f"{package}/csrc/{file}": text for file, text in core_files(model).items()}
        path = make_folder(folder)
        for file, text in made.items():
            make_folder((path / file).parent)
            write_bytes(path / file, text.encode())
        return [path / file for file in made]


def _blanks(model: Model, package: str) -> dict[str, object]:
    task = model.bundle.task
    sources = [f'      - "{channel.name}={_source(channel.name, channel.kind)}"' for channel in model.bundle.inputs]
    return {
        "name": model.name,
        "package": package,
        "version": __version__,
        "title": escape(describe_network(model.bundle.predictor.spec)),
        "model_hash": model_hash(model.graph),
        "rate": float(task.rate_hz),
        "tick_ms": f"{1000 / task.rate_hz:g}",
        "targets": ", ".join(task.targets),
        "sources": "\n".join(sources),
    }


def _source(name: str, kind: Kind) -> str:
    """A guess that the parameter file offers."""
    if kind in PRESSURES:
        return f"pressure:{name}"
    return f"{JOINTS.get(kind, 'effort')}:{name}"
