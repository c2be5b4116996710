"""The folder of an exported controller: its C files, the model's, the solver's, a self-test, an example, CMake."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from edp import __version__
from edp.errors import ExportError
from edp.export.c.model import RUNTIME
from edp.export.c.target import check_name
from edp.export.c.text import number
from edp.export.controller.files import c_runtime, own_file
from edp.export.controller.lanes import LaneModel, lane_model
from edp.export.controller.near import NearModel, near_model
from edp.export.controller.numbers import ConstantTables, constants_of_controller, golden_rows
from edp.export.controller.parts import AXES, ControllerParts, GoldenLoop, PlanParts
from edp.export.escape import C_SIGNIFICANT, Code, c_comment, c_names, fill
from edp.export.folder import write_export
from edp.export.si_names import si_channels
from edp.export.sizes import check_sizes
from edp.networks.input_range import HOLD_TICKS

SOLVER = tuple(f"daqp/{name}" for name in ("daqp.c", "auxiliary.c", "factorization.c"))
SOLVER_FILES = (*SOLVER, *(f"daqp/{name}.h" for name in ("daqp", "auxiliary", "factorization", "constants", "types")))
LICENCE = "daqp/LICENSE"
OWN = ("edp_control.h", "edp_control.c")
PROGRAM = ("edp_qp.h", "edp_qp.c")
LONGEST_NAME = 20
"""Of a controller: names of its model and functions are made from it."""
TOLERANCE = 2e-3
"""Of a lever of the self-test, a share of full: single precision against double at a tick from the same memory."""
PlanModel = LaneModel | NearModel
INCLUDES = ("edp_control.h", "edp_runtime.h")
LOOP_LEVERS = """\
    float strokes[EDP_AXES];
    for (uint32_t i = 0; i < EDP_AXES; i++) {
        strokes[i] = in[stroke_reads[i]];
    }
    /* At every tick, so that its sums are those of a loop that has always run. */
    edp_pi_levers(&gains, loop_sides, &limits, &c->reference, c->tick, strokes, c->sum, asked);
"""
PUBLIC = """\
    uint32_t fallbacks;   /* ticks without a solution of the plan */
    uint32_t iterations;  /* of the solver */
    uint32_t constraints; /* limits of strokes and pressures in its program */
    float disturbance[EDP_AXES]; /* m/s that the model does not know of */
    uint32_t limit; /* of iterations; may be lowered */
"""
PRIVATE = """\
    bool pending; /* values were measured that the model has not read yet */
    bool formed;
    uint32_t at;
    uint32_t seen;
    float measured[{NAME}_CONTROL_INPUTS];
    float latest[EDP_AXES];
    float speeds[{NAME}_CONTROL_BLOCKS][EDP_AXES]; /* the plan, m/s */
{model}    float moved[{NAME}_CONTROL_LANES][EDP_AXES];
    float targets[{NAME}_CONTROL_BLOCKS][EDP_AXES];
    float changed[{NAME}_CONTROL_BLOCKS][EDP_AXES];
    float changes[{NAME}_CONTROL_BLOCKS][EDP_AXES];
    float by_variable[{NAME}_CONTROL_VARIABLES][EDP_AXES];
    float slopes[{NAME}_CONTROL_VARIABLES];
    float squares[{NAME}_CONTROL_VARIABLES][{NAME}_CONTROL_VARIABLES];
    float products[{NAME}_CONTROL_VARIABLES];
    c_float hessian[{NAME}_CONTROL_VARIABLES][{NAME}_CONTROL_VARIABLES];
    c_float gradient[{NAME}_CONTROL_VARIABLES];
    c_float matrix[{NAME}_CONTROL_ROWS][{NAME}_CONTROL_VARIABLES];
    c_float lower[{NAME}_CONTROL_VARIABLES + {NAME}_CONTROL_ROWS];
    c_float upper[{NAME}_CONTROL_VARIABLES + {NAME}_CONTROL_ROWS];
    c_float numbers[EDP_QP_NUMBERS({NAME}_CONTROL_VARIABLES, {NAME}_CONTROL_ROWS)];
    int integers[EDP_QP_INTEGERS({NAME}_CONTROL_VARIABLES, {NAME}_CONTROL_ROWS)];
"""


@dataclass(frozen=True, eq=False)
class ControllerFiles:
    """Template values of one controller.

    Attributes:
        name: C prefix.
        parts: its numbers.
        model: of its plan; None for a PI loop alone.
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
        """Every file by name, the one to read first in front."""
        name = self.name
        texts: dict[str, str] = {
            f"{name}_control.h": self._fill_template("control.h.in"),
            f"{name}_control.c": self._fill_template("control.c.in"),
            f"{name}_control_numbers.h": self._numbers(),
        }
        texts |= self._runtime() if self.model is None else self.model.files()
        for file in OWN if self.model is None else (*OWN, *PROGRAM):
            texts[file] = own_file(f"runtime/{file}")
        if self.model is not None:
            texts |= {file: own_file(file) for file in (*SOLVER_FILES, LICENCE)}
        if self.parts.golden is not None:
            texts[f"{name}_control_golden.h"] = self._golden(self.parts.golden)
            texts["host_test.c"] = self._fill_template("host_test.c.in")
        texts["example_task.c"] = self._fill_template("example_task.c.in")
        texts["CMakeLists.txt"] = self._fill_template("CMakeLists.txt.in")
        return texts

    def _runtime(self) -> dict[str, str]:
        return {file: c_runtime(file) for file in RUNTIME}

    def _numbers(self) -> Code:
        head = f"/* Constants of {self.name}_control. Written by EDP {__version__}; do not edit. */\n"
        return Code(head + self.tables.finished())

    def _fill_template(self, template: str) -> Code:
        return fill(own_file(f"templates/{template}"), self._values())

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
            "input_enum": self._input_enum(),
            "tolerance": number(TOLERANCE),
            "sources": Code(" ".join(self.sources)),
            "solver": Code(" ".join(SOLVER)) if plan is not None else Code(""),
        }
        if plan is None or self.model is None:
            part, texts = "pi.c.in", self._pi_texts()
        else:
            part, texts = "plan.c.in", self._plan_texts(plan, self.model, places)
        values |= texts
        return values | {"parts": fill(own_file(f"templates/{part}"), values)}

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
            "recall": Code(RECALL_SUMS.format(at=AXES)),
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
        pressures = Code(model.pressure_rows.format(count=len(plan.pressures)) if plan.pressures else "")
        values = {**places, "pressure_rows": pressures}
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
            "public_fields": Code(PUBLIC + model.public),
            "private_fields": Code(PRIVATE.format(**places, model=model.private.format(**places))),
            "check_plant": Code(f" && {name}_plant_check()"),
            **{
                key: fill(own_file(f"templates/{model.fragment}{part}.c.in"), values)
                for key, part in {"model": "", "slopes": "_slopes", "predict": "_predict"}.items()
            },
            "loop_levers": Code(LOOP_LEVERS if plan.fallback else ""),
            "without_plan": Code(spare),
            "test_limit": Code(LIMIT_TEST.format(name=name, spare=spare)),
            "recall": self._recall(plan, model),
        }

    def _recall(self, plan: PlanParts, model: PlanModel) -> Code:
        """Return the statements of the self-test that set the state."""
        at = AXES
        lines = ""
        for field, size in (("speeds[0]", plan.variables), ("latest", AXES)):
            lines += f"    (void)memcpy(control.{field}, before + {at}, {size}u * sizeof(float));\n"
            at += size
        rest = f"    (void)memcpy(control.disturbance, before + {at + AXES}, EDP_AXES * sizeof(float));\n"
        rest += model.recalled.format(plant=f"{self.name}_plant", at=at + 2 * AXES)
        return Code(lines + RECALL_SUMS.format(at=at) + rest)

    def _input_enum(self) -> Code:
        upper = self.name.upper()
        names = c_names(
            (channel.name for channel in si_channels(self.parts.inputs)), C_SIGNIFICANT - len(f"{upper}_CONTROL_IN_")
        )
        return Code(
            "\n".join(
                f"    {upper}_CONTROL_IN_{own} = {i}, /* {c_comment('; '.join((channel.unit, channel.description)))} */"
                for i, (own, channel) in enumerate(zip(names, self.parts.inputs, strict=True))
            )
        )

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
        return Code(head + sizes + "".join(golden_rows(key, "float", rows) for key, rows in arrays.items()))


RECALL_SUMS = """\
    (void)memcpy(control.sum, before + {at}, EDP_AXES * sizeof(float));
"""
LIMIT_TEST = """\
    begin();
    control.limit = 1u;
    for (uint32_t tick = 0; tick < GOLDEN_TICKS; tick++) {{
        expect({name}_control_step(&control, golden_measured[tick], levers) == {spare},
               "at the limit of iterations another command is given");
        expect(within(levers), "levers are within their limits without a plan");
    }}
    expect(control.fallbacks == GOLDEN_TICKS, "ticks without a plan are counted");
"""


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
