"""Template values and files of both plant models of a controller."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from edp import __version__
from edp.export.c.model import Model, crc
from edp.export.c.text import filled, number
from edp.export.escape import c_comment, fill_file, package_text
from edp.export.hashes import model_hash, scale_hash
from edp.networks.twin import TwinPlant


def plant_values(model: Model, plant: TwinPlant) -> dict[str, object]:
    """Return the template values of the model of a plan that do not depend on its form."""
    return {
        "name": model.name,
        "NAME": model.name.upper(),
        "title": c_comment(plant.title),
        "version": __version__,
        "model_hash": model_hash(model.graph),
        "scale_hash": scale_hash(plant),
        "crc": crc(model.graph),
        "commands": plant.sizes[0],
        "answers": plant.sizes[1],
        "mean": filled(map(number, np.asarray(plant.twin.scales.answer_offset))),
    }


def plant_files(template: str, model: Model, values: Mapping[str, object], runtime: Sequence[str]) -> dict[str, str]:
    """Return model and runtime of a plan by file name.

    Args:
        template: name of the template of header and source, without its ending.
        model: the layers.
        values: values of the template.
        runtime: files of this package that the model needs in addition to its own.
    """
    path, name = f"controller/templates/{template}", model.name
    texts: dict[str, str] = {f"{name}.{end}": fill_file(f"{path}.{end}.in", values) for end in ("h", "c")}
    texts[f"{name}_weights.h"] = model.weights()
    texts |= model.runtime_texts()
    return texts | {file: package_text(f"controller/runtime/{file}") for file in runtime}
