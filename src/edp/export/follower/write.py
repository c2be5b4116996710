"""The folder of an exported follower: its C files, the grey box's, a self-test, an example, CMake."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.c.model import Model, crc, make_model
from edp.export.c.tables import ConstantTables
from edp.export.c.target import check_name
from edp.export.c.text import (
    channel_enumeration,
    enumeration,
    filled,
    identifier,
    initialiser_rows,
    number,
    reference_array,
    table,
    unsigned_literals,
)
from edp.export.controller.near import RUNTIME as NEAR
from edp.export.controller.near import WITHIN
from edp.export.escape import Code, c_comment, fill_file, package_text
from edp.export.folder import write_export
from edp.export.follower.parts import FollowerParts
from edp.export.hashes import model_hash, scale_hash
from edp.export.sizes import check_sizes
from edp.ir.hydraulics import HydraulicTick
from edp.networks.twin.adaptive_correction import JUDGED_S
from edp.networks.twin.adaptive_twin import LEAST, AdaptiveTwin
from edp.training.bundle import Bundle

OWN = ("edp_follow.h", "edp_follow.c")
LONGEST_NAME = 20
"""Maximum number of characters of a follower's name. Names of its functions are derived from it."""
UNKNOWN_C = 1e6
"""Value of an unknown temperature, far outside the range of thermometers."""
FORECAST, FACTOR = 5e-3, 2e-2
"""Tolerances of the self-test relative to Python: forecasts as a fraction of the velocities' standard deviation, and
factors. States are in single precision, and Newton's method stops at a small step.
"""


@dataclass(frozen=True, eq=False)
class FollowerFiles:
    """Template values of one follower.

    Attributes:
        name: C prefix.
        parts: content of the follower.
        model: layers of the grey box.
        machine: its layer of equations.
    """

    name: str
    parts: FollowerParts
    model: Model
    machine: HydraulicTick

    @property
    def sources(self) -> tuple[str, ...]:
        """C files that a program with this follower compiles."""
        runtime = (*self.model.runtime, *NEAR, *OWN)
        return (f"{self.name}.c", *(name for name in runtime if name.endswith(".c") and name != WITHIN))

    def texts(self) -> dict[str, str]:
        """Return every file by name, the one to read first in front."""
        name, values = self.name, self._values()
        texts: dict[str, str] = {
            f"{name}.{end}": fill_file(f"follower/templates/follower.{end}.in", values) for end in "hc"
        }
        texts[f"{name}_weights.h"] = self.model.weights()
        texts |= self.model.runtime_texts()
        texts |= {file: package_text(f"controller/runtime/{file}") for file in NEAR}
        texts |= {file: package_text(f"follower/runtime/{file}") for file in OWN}
        texts[f"{name}_golden.h"] = self._golden()
        for file in ("host_test.c", "example_task.c", "CMakeLists.txt"):
            texts[file] = fill_file(f"follower/templates/{file}.in", values)
        return texts

    @cached_property
    def tuned(self) -> AdaptiveTwin:
        """The follower in Python."""
        return self.parts.correction().tuned

    @cached_property
    def tables(self) -> ConstantTables:
        """All constants that are not the grey box's."""
        correction, tables = self.parts.correction(), ConstantTables("follower")
        which, group = np.nonzero(self.tuned.moves)
        tables.floats("floors", (LEAST * self._widths.astype(np.float64)) ** 2)
        tables.floats("powers", self.tuned.moves[which, group])
        tables.places("entry_number", which.tolist())
        tables.places("entry_group", group.tolist())
        tables.floats("deviation", self.tuned.deviation)
        tables.floats("warmth", self.tuned.warmth)
        tables.places("columns", correction.columns)
        tables.places("ahead", self.parts.horizons)
        return tables

    @property
    def _widths(self) -> np.ndarray:
        """Spread of each velocity, SI units."""
        twin = self.parts.twin
        return np.asarray(twin.scales.answer_width[: len(twin.channels.velocities)])

    @cached_property
    def sizes(self) -> dict[str, int]:
        """Numbers of inputs, outputs and states."""
        parts, machine, channels = self.parts, self.machine, self.parts.twin.channels
        actuators, valves, pumps = machine.sizes
        velocities, groups = len(channels.velocities), len(self.tuned.labels)
        ticks, reach = parts.spec.learn_ticks, max(parts.horizons)
        horizons, targets = len(parts.horizons), len(parts.targets)
        sizes = {
            "commands": len(channels.commands), "answers": len(channels.answers), "velocities": velocities,
            "targets": targets, "horizons": horizons, "groups": groups, "runs": groups + 1, "reach": reach,
            "numbers": len(machine.numbers), "entries": int(np.count_nonzero(self.tuned.moves)),
            "state": machine.unknown + 2 * actuators + max(pumps, 1) + valves * (5 + machine.remembered),
            "actuators": actuators, "valves": valves, "pumps": pumps, "most": max(groups, velocities),
            "reach_demands": reach * valves, "stretch_demands": ticks * valves, "truth": ticks * velocities,
            "ring": 2 * reach * horizons * targets, "slopes": ticks * velocities * groups, "room": machine.room,
            "learn_ticks": ticks, "most_ticks": reach + velocities + ticks,
        }  # fmt: skip
        check_sizes({"bytes of its stretches": 8 * sizes["slopes"], "bytes of its predictions": 4 * sizes["ring"]})
        check_sizes({"entries of its groups": sizes["entries"]}, 2**16 - 1)
        return sizes

    @property
    def state_bytes(self) -> int:
        """About, of the memory of one machine."""
        s = self.sizes
        floats = 2 * s["numbers"] + 4 * s["state"] + 4 * s["answers"] + s["reach_demands"] + s["ring"]
        floats += 2 * (s["stretch_demands"] + s["truth"]) + s["horizons"] * (s["velocities"] + s["targets"] + 1)
        doubles = 3 * s["actuators"] + 2 * s["groups"] + s["groups"] ** 2 + s["velocities"] * (2 + s["velocities"])
        doubles += 3 * s["horizons"] * s["targets"] + s["truth"] + s["slopes"] + 2 * s["most"] * (s["most"] + 1)
        near = s["actuators"] * 6 + s["pumps"] * 7 + 13 * s["valves"]
        return 4 * (floats + 15) + 8 * (doubles + s["room"] + near) + s["valves"]

    def _law(self) -> Code:
        """Return counts and factors in the order of `edp_follow_law`."""
        spec, rate, s = self.parts.spec, self.parts.twin.channels.rate_hz, self.sizes
        keep = math.exp(-spec.learn_ticks / (spec.forgetting_s * rate))
        oil = UNKNOWN_C if math.isnan(spec.oil_c) else spec.oil_c
        named = ["numbers", "commands", "entries", "groups", "velocities", "targets", "horizons", "reach"]
        counts = [*(s[name] for name in named), self.parts.twin.prefix_ticks, spec.learn_ticks, s["state"], s["most"]]
        shares = [number(spec.gain), number(spec.load_share), repr(keep), number(oil), repr(1.0 / (JUDGED_S * rate))]
        return filled([*unsigned_literals(counts), *shares])

    def _values(self) -> dict[str, object]:
        parts, twin, graph = self.parts, self.parts.twin, self.model.graph
        channels, upper, tables = twin.channels, self.name.upper(), self.tables
        speeds = {channel.name: channel for channel in channels.velocities}
        ahead = [f"{k} ticks, {1000 * k / channels.rate_hz:g} ms" for k in parts.horizons]
        return self.sizes | {
            "name": self.name,
            "NAME": upper,
            "title": c_comment(parts.title),
            "version": __version__,
            "model_hash": model_hash(graph),
            "scale_hash": scale_hash(self.model.bundle.predictor),
            "ticks_hz": f"{channels.rate_hz:g}",
            "tick_ms": f"{1000 / channels.rate_hz:g}",
            "judged": f"{JUDGED_S:g}",
            "flash": tables.bytes,
            "ram": self.state_bytes,
            "crc": tables.crc,
            "weights_crc": crc(graph),
            # Odd, so that zeroed memory does not look like a follower that was reset.
            "marker": int(hashlib.blake2b(repr((tables.crc, crc(graph))).encode(), digest_size=4).hexdigest(), 16) | 1,
            "command_enum": channel_enumeration(f"{upper}_COMMAND_", channels.commands),
            "answer_enum": channel_enumeration(f"{upper}_MEASURED_", channels.answers),
            "target_enum": channel_enumeration(f"{upper}_TARGET_", [speeds[name] for name in parts.targets]),
            "horizon_enum": enumeration(f"{upper}_AHEAD_", map(str, parts.horizons), ahead),
            "group_enum": enumeration(f"{upper}_GROUP_", self.tuned.labels, self.tuned.labels),
            "low": filled(map(number, np.asarray(twin.scales.low) / twin.units)),
            "high": filled(map(number, np.asarray(twin.scales.high) / twin.units)),
            "constants": Code("\n".join(tables.lines)),
            "own_tables": Code(", ".join(tables.entries)),
            "limits": initialiser_rows(map(number, row) for row in parts.limit),
            "law": self._law(),
            "machine": f"{identifier(self.machine.name)}_machine",
            "sources": Code(" ".join(self.sources)),
            "forecast_tolerance": number(FORECAST * float(self._widths.max())),
            "factor_tolerance": number(FACTOR),
        }

    def _golden(self) -> Code:
        golden = self.parts.golden()
        head = "/* Ticks of a machine that has changed, and what the Python package makes of them. */\n"
        head += (
            f"#include <math.h>\n#define GOLDEN_TICKS {len(golden.inputs)}u\n#define GOLDEN_TAUGHT {golden.taught}u\n"
        )
        rows = (["NAN" if math.isnan(value) else number(value) for value in row] for row in golden.forecasts)
        arrays = (
            reference_array("float", "golden_inputs", golden.inputs),
            table("float", f"golden_forecasts[GOLDEN_TICKS][{golden.forecasts.shape[1]}]", rows),
            reference_array("float", "golden_factors", golden.factors[None]),
        )
        return Code(head + "".join(f"{definition}\n" for definition in arrays))


def write_follower(parts: FollowerParts, plant: Bundle, name: str, folder: Path) -> list[Path]:
    """Write a follower under `folder`, in place of the export that it holds.

    Args:
        parts: content of the follower.
        plant: its grey box as exported forms take it (`edp.training.twin_bundle.plant_bundle`).
        name: prefix of its C functions and files.
        folder: made when absent.

    Returns:
        The files, the one to read first in front.

    Raises:
        ExportError: the name or the grey box cannot be written.
        StorageError: the folder cannot be written.
    """
    check_name(name)
    if len(name) > LONGEST_NAME:
        raise ExportError(f"name '{name}' of a follower has {len(name)} characters; at most {LONGEST_NAME} must hold")
    files = follower_files(parts, plant, name)
    return write_export(folder, {file: text.encode() for file, text in files.texts().items()})


def follower_files(parts: FollowerParts, plant: Bundle, name: str) -> FollowerFiles:
    """Create a follower ready to be written; see `write_follower`.

    Raises:
        ExportError: the grey box has no layer of its equations.
    """
    model = make_model(name, plant)
    machine = next((layer for layer in model.graph.layers if isinstance(layer, HydraulicTick)), None)
    if machine is None:
        raise ExportError("the grey box has no layer of its equations; fit it again with edp twin")
    return FollowerFiles(name, parts, model, machine)
