"""The folder of an exported controller: its C files, the model's, the solver's, a self-test, an example, CMake."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.c.model import RUNTIME
from edp.export.c.tables import ConstantTables
from edp.export.c.target import check_name
from edp.export.c.text import channel_enumeration, number, reference_array
from edp.export.controller.lanes import LaneModel, lane_model
from edp.export.controller.near import NearModel, near_model
from edp.export.controller.numbers import constants_of_controller
from edp.export.controller.parts import AXES, ControllerParts, GoldenLoop, PlanParts
from edp.export.escape import Code, c_comment, fill_file, package_text
from edp.export.folder import write_export
from edp.export.sizes import check_sizes
from edp.networks.input_range import HOLD_TICKS

SOLVER = tuple(f"daqp/{name}" for name in ("daqp.c", "auxiliary.c", "factorization.c"))
SOLVER_FILES = (*SOLVER, *(f"daqp/{name}.h" for name in ("daqp", "auxiliary", "factorization", "constants", "types")))
LICENCE = "daqp/LICENSE"
TEMPLATES = "controller/templates"
OWN = ("edp_control.h", "edp_control.c")
PROGRAM = ("edp_qp.h", "edp_qp.c")
LONGEST_NAME = 20
"""Maximum number of characters of a controller's name. Names of its model and functions are derived from it."""
TOLERANCE = 2e-3
"""Tolerance of a lever command in the self-test, as a fraction of full travel: single compared with double precision
for one sample from equal memory.
"""
PlanModel = LaneModel | NearModel
INCLUDES = ("edp_control.h", "edp_runtime.h")


@dataclass(frozen=True, eq=False)
class ControllerFiles:
    """Template values of one controller.

    Attributes:
        name: C prefix.
        parts: its numbers.
        model: model of its plan; None for a PI loop alone.
        tables: its constants.
    """

    name: str
    parts: ControllerParts
    model: PlanModel | None
    tables: ConstantTables

    @property
    def sources(self) -> tuple[str, ...]:
        """C files that a program with this controller compiles."""
        own = (f"{self.name}_control.c", "edp_control.c")
        if self.model is None:
            return (*own, *(name for name in RUNTIME if name.endswith(".c")))
        return (*own, "edp_qp.c", *SOLVER, *self.model.sources)

    def texts(self) -> dict[str, str]:
        """Return every file by name, the one to read first in front."""
        name = self.name
        texts: dict[str, str] = {
            f"{name}_control.h": self._fill_template("control.h.in"),
            f"{name}_control.c": self._fill_template("control.c.in"),
            f"{name}_control_numbers.h": self._numbers(),
        }
        texts |= {f: package_text(f"c/runtime/{f}") for f in RUNTIME} if self.model is None else self.model.files()
        for file in OWN if self.model is None else (*OWN, *PROGRAM):
            texts[file] = package_text(f"controller/runtime/{file}")
        if self.model is not None:
            texts |= {file: package_text(f"controller/{file}") for file in (*SOLVER_FILES, LICENCE)}
        if self.parts.golden is not None:
            texts[f"{name}_control_golden.h"] = self._golden(self.parts.golden)
            texts["host_test.c"] = self._fill_template("host_test.c.in")
        texts["example_task.c"] = self._fill_template("example_task.c.in")
        texts["CMakeLists.txt"] = self._fill_template("CMakeLists.txt.in")
        return texts

    def _numbers(self) -> Code:
        head = f"/* Constants of {self.name}_control. Written by EDP {__version__}; do not edit. */\n"
        return Code(head + self.tables.finished())

    def _fill_template(self, template: str) -> Code:
        return fill_file(f"{TEMPLATES}/{template}", self._values())

    def _values(self) -> dict[str, object]:
        parts, plan, name = self.parts, self.parts.plan, self.name
        upper = name.upper()
        places = {"name": name, "NAME": upper, "plant": f"{name}_plant", "PLANT": f"{upper}_PLANT"}
        values: dict[str, object] = {
            **places,
            "title": c_comment(parts.title),
            "machine": c_comment(parts.machine),
            "version": __version__,
            "inputs": len(parts.inputs),
            "rate": number(parts.rate_hz),
            "ticks_hz": f"{parts.rate_hz:g}",
            "tick_ms": f"{1000 / parts.rate_hz:g}",
            "hold": HOLD_TICKS,
            "crc": self.tables.crc,
            # Odd, so that zeroed memory does not look like a controller that has begun.
            "marker": int(hashlib.blake2b(repr(self.tables.crc).encode(), digest_size=4).hexdigest(), 16) | 1,
            "input_enum": channel_enumeration(f"{upper}_CONTROL_IN_", parts.inputs),
            "tolerance": number(TOLERANCE),
            "sources": Code(" ".join(self.sources)),
            "solver": Code(" ".join(SOLVER)) if plan is not None else Code(""),
        }
        if plan is None or self.model is None:
            part, texts = "pi.c.in", self._pi_texts()
        else:
            part, texts = "plan.c.in", self._plan_texts(plan, self.model, places)
        values |= texts
        return values | {"parts": fill_file(f"{TEMPLATES}/{part}", values)}

    def _pi_texts(self) -> dict[str, object]:
        return {
            "what": Code(" * A PI loop of the strokes, with feed-forward through the inverse valve map."),
            "rules": Code("."),
            "cost": Code(f" * COST. Constants {self.tables.bytes} bytes; a tick has no loop of a length that varies."),
            "includes": Code("\n".join(f'#include "{file}"' for file in INCLUDES)),
            "sizes": Code(""),
            "public_fields": Code(""),
            "private_fields": Code(""),
            "check_plant": Code(""),
            "test_limit": Code(""),
            "recall": Code(f"    (void)memcpy(control.sum, before + {AXES}, EDP_AXES * sizeof(float));\n"),
        }

    def _plan_texts(self, plan: PlanParts, model: PlanModel, places: dict[str, str]) -> dict[str, object]:
        name, upper = self.name, self.name.upper()
        sizes = {
            "BLOCKS": len(plan.blocks),
            "VARIABLES": plan.variables,
            "LANES": plan.variables + 1,
            "WINDOW": plan.window,
            "ROWS": plan.rows,
            "ITERATIONS": plan.iterations,
            **model.sizes(plan),
        }
        spare = "EDP_CONTROL_FALLBACK" if plan.fallback else "EDP_CONTROL_NEUTRAL"
        answers = "the PI loop answers (EDP_CONTROL_FALLBACK)" if plan.fallback else "levers go to neutral"
        includes = (f"{name}_plant.h", *INCLUDES, "edp_qp.h")
        values: dict[str, object] = {
            **places,
            "count": len(plan.pressures),
            "spare": spare,
            "variables": plan.variables,
            # Where the golden loop has what was remembered, see `GoldenLoop.before`; levers come first.
            "speeds_at": AXES,
            "latest_at": AXES + plan.variables,
            "sum_at": 2 * AXES + plan.variables,
            "disturbance_at": 3 * AXES + plan.variables,
            "resistance_at": 4 * AXES + plan.variables,
        }

        def text(file: str) -> Code:
            return fill_file(f"{TEMPLATES}/{file}.in", values)

        def own(part: str) -> Code:
            return text(f"{model.template}_{part}") if part in model.fragments else Code("")

        values["pressure_rows"] = own("pressures.c") if plan.pressures else Code("")
        values["model"] = own("fields.h")
        return {
            "what": Code(
                f" * It plans {sum(plan.blocks)} ticks ahead on a twin ({name}_plant) in {len(plan.blocks)} "
                "blocks: one Gauss-Newton step a tick,\n * whose quadratic program DAQP solves (daqp/, MIT licence)."
            ),
            "rules": Code(
                f",\n * while the model runs on without them. Where the program has no solution within "
                f"{upper}_CONTROL_ITERATIONS\n * iterations, {answers}."
            ),
            "cost": Code(f"{model.cost(plan)} Constants beside the\n * model's: {self.tables.bytes} bytes."),
            "includes": Code("\n".join(f'#include "{file}"' for file in sorted(includes))),
            "sizes": Code("\n".join(f"#define {upper}_CONTROL_{key} {value}u" for key, value in sizes.items())),
            "public_fields": Code(text("plan_public.h") + own("public.h")),
            "private_fields": text("plan_fields.h"),
            "check_plant": Code(f" && {name}_plant_check()"),
            "model": text(f"{model.template}.c"),
            "slopes": text(f"{model.template}_slopes.c"),
            "predict": text(f"{model.template}_predict.c"),
            "loop_levers": text("plan_loop_levers.c") if plan.fallback else Code(""),
            "without_plan": Code(spare),
            "test_limit": text("plan_limit_test.c"),
            "recall": Code(text("plan_recall.c") + own("recall.c")),
        }

    def _golden(self, golden: GoldenLoop) -> Code:
        arrays = {
            "golden_measured": golden.measured,
            "golden_before": golden.before,
            "golden_levers": golden.levers,
            "golden_strokes": golden.strokes,
            "golden_tip": golden.tip,
        }
        head = f"/* A stretch of a loop of {self.name}_control as it ran in Python. */\n"
        sizes = f"#define GOLDEN_TICKS {len(golden.levers)}u\n#define GOLDEN_ROWS {len(golden.strokes)}u\n"
        return Code(
            head
            + sizes
            + "".join(
                f"{reference_array('float', key, np.asarray(rows, np.float32))}\n" for key, rows in arrays.items()
            )
        )


def write_controller(parts: ControllerParts, name: str, folder: Path) -> list[Path]:
    """Write a controller under `folder`, in place of the export that it holds.

    Args:
        parts: its numbers.
        name: prefix of its C functions and files.
        folder: made when absent.

    Returns:
        The files, the one to read first in front.

    Raises:
        ExportError: the name or the model cannot be written.
        StorageError: the folder cannot be written.
    """
    check_name(name)
    if len(name) > LONGEST_NAME:
        raise ExportError(f"name '{name}' of a controller has {len(name)} characters; at most {LONGEST_NAME} must hold")
    check_sizes({"rows of the self-test": 0 if parts.golden is None else len(parts.golden.strokes)})
    model: PlanModel | None = None
    if parts.plan is not None:
        own = f"{name}_plant"
        model = near_model(own, parts.plan) or lane_model(own, parts.plan.plant)
    files = ControllerFiles(name, parts, model, constants_of_controller(parts, isinstance(model, NearModel)))
    return write_export(folder, {file: text.encode() for file, text in files.texts().items()})


__all__ = ["AXES", "ControllerFiles", "write_controller"]
