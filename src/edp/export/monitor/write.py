"""The folder of an exported monitor: its C files, its networks, the runtime, a self-test, an example, CMake."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.c.model import RUNTIME
from edp.export.c.tables import ConstantTables
from edp.export.c.target import check_name, core_files
from edp.export.c.text import (
    bool_literal,
    channel_enumeration,
    double_number,
    enumeration,
    indented,
    number,
    struct,
    table,
    unsigned_literals,
)
from edp.export.escape import C_SIGNIFICANT, Code, c_comment, fill_file, package_text
from edp.export.folder import write_export
from edp.export.monitor.golden import JUDGED_BLOCKS, MISSING, SEED, SHIFT, golden_blocks, golden_header
from edp.export.monitor.parts import DETECTORS, ROW, MonitorParts, pieces
from edp.export.monitor.sources import SourceCode, source_code
from edp.export.sizes import check_sizes
from edp.monitor.conditioning import GROSS, POINT_LIMIT
from edp.monitor.monitor import IMPOSSIBLE
from edp.networks.input_range import HOLD_TICKS

OWN = ("edp_chain.h", "edp_chain.c")
LONGEST_NAME = 20
"""Maximum number of characters of a monitor's name. Names of its networks and functions are derived from it."""
NO_INPUT = 0xFFFF
"""Index of the second input of a driver without one: `EDP_NO_INPUT`."""
MAX_MEMORY = 2**31 - 1


@dataclass(frozen=True, eq=False)
class MonitorFiles:
    """Template values of one monitor.

    Attributes:
        name: C prefix.
        parts: its numbers.
        sources: sources of its residuals, as C.
    """

    name: str
    parts: MonitorParts
    sources: tuple[SourceCode, ...]

    def texts(self) -> dict[str, str]:
        """Return every file by name, the one to read first in front."""
        name = self.name
        texts: dict[str, str] = {
            f"{name}.h": self._fill_template("monitor.h.in"),
            f"{name}.c": self._fill_template("monitor.c.in"),
            f"{name}_numbers.h": self._numbers(),
        }
        texts |= {file: package_text(f"monitor/runtime/{file}") for file in OWN}
        texts |= {file: package_text(f"c/runtime/{file}") for file in RUNTIME}
        for source in self.sources:
            texts |= {} if source.model is None else core_files(source.model)
        return texts

    def folder_texts(self) -> dict[str, str]:
        """Return the texts with self-test, example and CMake file."""
        return self.texts() | {
            f"{self.name}_golden.h": golden_header(self.name, self.parts),
            "host_test.c": self._fill_template("host_test.c.in"),
            "example_task.c": self._fill_template("example_task.c.in"),
            "CMakeLists.txt": self._fill_template("CMakeLists.txt.in"),
        }

    @property
    def compiled(self) -> list[str]:
        """C files that a program with this monitor compiles."""
        networks = [file for s in self.sources if s.model is not None for file in s.model.sources]
        runtime = [file for file in RUNTIME if file.endswith(".c")]
        return list(dict.fromkeys([f"{self.name}.c", "edp_chain.c", *networks, *runtime]))

    @property
    def slices(self) -> int:
        """Parts of the work on a block: operating point, residuals and their summaries, watches, verdict, evidence."""
        residuals = (self.parts.each + 1) * len(self.parts.residuals)
        evidence = len(pieces(self.parts.chain.summaries.width, ROW))
        return 2 + residuals + sum(view.slices for view in self.parts.watches) + evidence

    def _numbers(self) -> Code:
        head = f"/* Constants of {self.name}. Written by EDP {__version__}; do not edit. */\n"
        return Code(head + self.tables.finished())

    @cached_property
    def tables(self) -> ConstantTables:
        """The constants."""
        chain, tables = self.parts.chain, ConstantTables("monitor")
        summaries, conditioning = chain.summaries, chain.conditioning
        tables.places("reads", [column for columns in self.parts.reads for column in columns])
        tables.places("reads_from", np.cumsum([0, *map(len, self.parts.reads)]).tolist())
        for source in self.sources:
            source.constants(tables)
        for name in ("centre", "spread", "scale", "change"):
            tables.doubles(name, getattr(summaries, name))
        for name in ("channel", "level", "moving"):
            tables.places(name, getattr(summaries, name).tolist())
        pairs = summaries.drivers.transpose(1, 0, 2).reshape(-1, 2)
        tables.places("driver_first", pairs[:, 0].tolist())
        tables.places("driver_second", np.where(pairs[:, 1] < 0, NO_INPUT, pairs[:, 1]).tolist())
        counted = (summaries.centre, summaries.scale, summaries.level, summaries.moving, summaries.drivers)
        arrays = ("centre", "spread", "scale", "change", "channel", "level", "moving", "driver_first", "driver_second")
        tables.text(
            struct("edp_blocks", "blocks", [*unsigned_literals((summaries.block, *map(len, counted))), *arrays])
        )
        lines = {
            "point_offset": conditioning.offset,
            "point_width": conditioning.width,
            "usual": conditioning.usual,
            "wide": conditioning.spread,
            "least": conditioning.floor,
        }
        for name, values in lines.items():
            tables.singles(name, values)
        self._enter_watches(tables)
        scalars = {
            "IMPOSSIBLE": IMPOSSIBLE,
            "POINT_LIMIT": POINT_LIMIT,
            "CLIP": conditioning.clip,
            "GROSS": GROSS,
            "DRIFT_STEP": chain.drift.step,
            "DRIFT_MOST": chain.drift.most,
            "ALARM_LIMIT": chain.limit,
            "QUIET": chain.quiet,
        }
        for name, value in scalars.items():
            tables.text(f"#define {name} {double_number(value)}")
        tables.text(f"#define POINTS {self.parts.points}u")
        tables.text(f"#define BLOCK_S {number(summaries.block / self.parts.rate_hz)}")
        return tables

    def _enter_watches(self, tables: ConstantTables) -> None:
        watches, rows = self.parts.watches, []
        for index, view in enumerate(watches):
            tables.singles(f"mean_{index}", view.watch.mean)
            tables.singles(f"matrix_{index}", np.ascontiguousarray(view.watch.matrix.T))
            weight = view.option if view.detector == "ewma" else 1.0
            sizes = unsigned_literals((self.parts.chain.summaries.width, view.directions, view.rows))
            options = map(double_number, (view.option, (2.0 - weight) / weight, view.watch.scale))
            arrays = (f"mean_{index}", f"matrix_{index}")
            rows.append([DETECTORS[view.detector], bool_literal(view.watch.own), *sizes, *options, *arrays])
        tables.text(table("edp_watch", f"watches[{len(rows)}]", rows))
        memories = np.cumsum([0, *(view.memory for view in watches[:-1])]).tolist()
        tables.text(struct("uint32_t", f"memory_from[{len(memories)}]", unsigned_literals(memories)))
        first = 1 + (self.parts.each + 1) * len(self.parts.residuals)
        starts = (first + np.cumsum([0, *(view.slices for view in watches)])).tolist()
        tables.text(struct("uint32_t", f"slices_from[{len(starts)}]", unsigned_literals(starts)))

    def _fill_template(self, template: str) -> Code:
        return fill_file(f"monitor/templates/{template}", self._values())

    def _values(self) -> dict[str, object]:
        parts, chain, summaries = self.parts, self.parts.chain, self.parts.chain.summaries
        models = [source.model for source in self.sources if source.model is not None]
        checks = "".join(f" && {model.name}_check()" for model in models)
        headers = sorted({"edp_chain.h", "edp_runtime.h", *(f"{model.name}.h" for model in models)})
        return {
            "name": self.name,
            "NAME": self.name.upper(),
            "title": c_comment(parts.title),
            "promise": c_comment(parts.promise),
            "version": __version__,
            "hash": parts.digest,
            # Odd, so that zeroed memory does not look like a state that was reset.
            "marker": int(hashlib.blake2b(parts.digest.encode(), digest_size=4).hexdigest(), 16) | 1,
            "crc": self.tables.double_crc,
            "rate": number(parts.rate_hz),
            "rate_hz": f"{parts.rate_hz:g}",
            "tick_ms": f"{1000 / parts.rate_hz:g}",
            "block": summaries.block,
            "block_s": f"{summaries.block / parts.rate_hz:g}",
            "settle": chain.settle,
            "hold": HOLD_TICKS,
            "limit": f"{IMPOSSIBLE:.0f}",
            "inputs": len(parts.inputs),
            "residuals": len(parts.residuals),
            "each": parts.each,
            "drivers": len(summaries.drivers),
            "levels": len(summaries.level),
            "moving": len(summaries.moving),
            "points": max(1, parts.points),
            "watches": len(parts.watches),
            "widest": max(view.directions for view in parts.watches),
            "memory": sum(view.memory for view in parts.watches),
            "slices": self.slices,
            "slices_per_tick": -(-self.slices // summaries.block),
            "includes": Code("\n".join(f'#include "{file}"' for file in headers)),
            "cost": self._cost(),
            "check_networks": Code(checks),
            "compiled": Code(" ".join(self.compiled)),
            **self._enums(),
            **self._source_texts(),
            **self._golden_sizes(),
        }

    def _cost(self) -> Code:
        models = [source.model for source in self.sources if source.model is not None]
        macs = sum(model.graph.macs for model in models)
        return Code(
            f" * COST PER TICK. {macs} multiply-accumulates of {len(models)} network(s); of the rest about "
            f"{self.double_operations} operations in double\n * precision. Constants beside those of the networks "
            f"{self.tables.bytes} bytes. The number of operations is the same at\n * every tick, but for parts of the "
            "work on a block, which are of different length."
        )

    @property
    def double_operations(self) -> int:
        """Number of double operations per sample on average; + - * / each count as one."""
        summaries, points = self.parts.chain.summaries, self.parts.points
        tick = (
            (14 + 5 * len(summaries.drivers)) * len(summaries.scale)
            + 2 * len(summaries.centre)
            + len(summaries.level)
            + len(summaries.moving)
        )
        white = sum(2 * view.watch.matrix.size + 5 * view.memory for view in self.parts.watches)
        return tick + round((summaries.width * (4 * points + 12) + white) / summaries.block)

    def _enums(self) -> dict[str, Code]:
        upper, parts = self.name.upper(), self.parts
        longest = C_SIGNIFICANT - len(f"{upper}_RES_")
        views = [f"{view.detector}, {view.directions} directions" for view in parts.watches]
        return {
            "input_enum": channel_enumeration(f"{upper}_IN_", parts.inputs, longest),
            "residual_enum": enumeration(f"{upper}_RES_", parts.residuals, parts.residuals, longest),
            "watch_enum": enumeration(f"{upper}_STAT_", map(str, range(len(views))), views),
        }

    def _source_texts(self) -> dict[str, Code]:
        code, calls, first = [], [], 0
        for source in self.sources:
            text = source.code(self.name, first)
            code.append(text)
            # The last function of a source is the one that fills its residuals.
            calls.append(f"{text.split('static void ')[-1].split('(')[0]}(s);")
            first += source.residuals
        return {
            "source_fields": indented([line for source in self.sources for line in source.fields()]),
            "sources": Code("".join(code)),
            "calls": indented(calls),
            "reset_sources": indented([line for source in self.sources for line in source.reset()]),
            "reset_networks": indented([line for source in self.sources for line in source.forget()], "        "),
        }

    def _golden_sizes(self) -> dict[str, object]:
        chain = self.parts.chain
        blocks = golden_blocks(chain)
        return {
            "golden_blocks": blocks,
            "golden_late": blocks - JUDGED_BLOCKS // 2,
            "golden_seed": SEED,
            "golden_missing": MISSING,
            "golden_shift": number(SHIFT),
        }


def monitor_files(parts: MonitorParts, name: str) -> MonitorFiles:
    """Create a monitor ready to be written.

    Args:
        parts: its numbers.
        name: prefix of its C functions and files.

    Raises:
        ExportError: the name, a detector or a network has no form in C.
    """
    check_name(name)
    if len(name) > LONGEST_NAME:
        raise ExportError(f"name '{name}' of a monitor has {len(name)} characters; at most {LONGEST_NAME} must hold")
    memory, block = sum(view.memory for view in parts.watches), parts.chain.summaries.block
    check_sizes({"bytes of the detectors' memory": 8 * memory, "ticks of a block": block}, MAX_MEMORY)
    sources = (source_code(part, index, name, parts.columns) for index, part in enumerate(parts.sources))
    return MonitorFiles(name, parts, tuple(sources))


def write_monitor(parts: MonitorParts, name: str, folder: Path) -> list[Path]:
    """Write a monitor under `folder`, in place of the export that it holds.

    Args:
        parts: its numbers.
        name: prefix of its C functions and files.
        folder: made when absent.

    Returns:
        The files, the one to read first in front.

    Raises:
        ExportError: the name or a part cannot be written.
        StorageError: the folder cannot be written.
    """
    texts = monitor_files(parts, name).folder_texts()
    return write_export(folder, {file: text.encode() for file, text in texts.items()})
