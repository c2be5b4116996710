"""The folder of an exported monitor: its C files, its networks, the runtime, a self-test, an example, CMake."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from importlib import resources
from pathlib import Path

import numpy as np

from edp import __version__
from edp.errors import ExportError
from edp.export.c.model import RUNTIME
from edp.export.c.target import check_name, core_files
from edp.export.c.text import indented, number
from edp.export.escape import C_SIGNIFICANT, Code, c_comment, c_names, fill
from edp.export.folder import write_export
from edp.export.monitor.golden import JUDGED_BLOCKS, MISSING, SEED, SHIFT, golden_blocks
from edp.export.monitor.numbers import MonitorTables, double_number, golden_header
from edp.export.monitor.parts import PIECE, ROW, MonitorParts, WatchPart, pieces
from edp.export.monitor.sources import SourceCode, reads_tables, source_code
from edp.export.si_names import si_channels
from edp.export.sizes import check_sizes
from edp.networks.input_range import HOLD_TICKS

OWN = ("edp_chain.h", "edp_chain.c")
LONGEST_NAME = 20
"""Of a monitor: names of its networks and functions are made from it."""
DETECTORS = {
    "cusum": "EDP_CUSUM",
    "ewma": "EDP_EWMA",
    "glr": "EDP_GLR",
    "separate_cusums": "EDP_SEPARATE_CUSUMS",
}
NO_INPUT = 0xFFFF
"""Stands for a driver without a second input: `EDP_NO_INPUT`."""
MOST_MEMORY = 2**31 - 1


@dataclass(frozen=True, eq=False)
class MonitorFiles:
    """Template values of one monitor.

    Attributes:
        name: C prefix.
        parts: its numbers.
        sources: of its residuals, as C.
    """

    name: str
    parts: MonitorParts
    sources: tuple[SourceCode, ...]

    def texts(self) -> dict[str, str]:
        """Every file by name, the one to read first in front."""
        name = self.name
        texts: dict[str, str] = {
            f"{name}.h": self._fill_template("monitor.h.in"),
            f"{name}.c": self._fill_template("monitor.c.in"),
            f"{name}_numbers.h": self._numbers(),
        }
        texts |= {file: _own(f"runtime/{file}") for file in OWN}
        texts |= {file: resources.files("edp.export.c").joinpath(f"runtime/{file}").read_text() for file in RUNTIME}
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
        evidence = len(pieces(self.parts.summaries, ROW))
        return 2 + residuals + sum(map(_watch_slices, self.parts.chain.watches)) + evidence

    def _numbers(self) -> Code:
        head = f"/* Constants of {self.name}. Written by EDP {__version__}; do not edit. */\n"
        return Code(head + self.tables.finished())

    @cached_property
    def tables(self) -> MonitorTables:
        """The constants."""
        chain, tables = self.parts.chain, MonitorTables()
        reads_tables(self.parts.reads, tables)
        for source in self.sources:
            source.constants(tables)
        for name in ("centre", "spread", "scale", "change"):
            tables.doubles(name, getattr(chain, name))
        for name in ("channel", "level", "moving"):
            tables.places(name, getattr(chain, name))
        pairs = chain.drivers.transpose(1, 0, 2).reshape(-1, 2)
        tables.places("driver_first", pairs[:, 0].tolist())
        tables.places("driver_second", np.where(pairs[:, 1] < 0, NO_INPUT, pairs[:, 1]).tolist())
        sizes = (
            chain.block,
            len(chain.centre),
            len(chain.scale),
            len(chain.level),
            len(chain.moving),
            len(chain.drivers),
        )
        arrays = "centre, spread, scale, change, channel, level, moving, driver_first, driver_second"
        named = ", ".join([*(f"{size}u" for size in sizes), arrays])
        tables.text(f"static const edp_blocks blocks = {{{named}}};")
        for name in ("point_offset", "point_width", "usual", "wide", "least"):
            tables.singles(name, getattr(chain, name))
        self._enter_watches(tables)
        self._enter_scalars(tables)
        return tables

    def _enter_watches(self, tables: MonitorTables) -> None:
        rows = []
        for index, watch in enumerate(self.parts.chain.watches):
            tables.singles(f"mean_{index}", watch.mean)
            tables.singles(f"matrix_{index}", np.ascontiguousarray(watch.matrix.T))
            weight = watch.option if watch.detector == "ewma" else 1.0
            sizes = f"{self.parts.summaries}u, {watch.directions}u, {watch.rows}u"
            options = ", ".join(map(double_number, (watch.option, (2.0 - weight) / weight, watch.scale)))
            own = "true" if watch.own else "false"
            rows.append(f"    {{{DETECTORS[watch.detector]}, {own}, {sizes}, {options}, mean_{index}, matrix_{index}}}")
        body = ",\n".join(rows)
        tables.text(f"static const edp_watch watches[{len(rows)}] = {{\n{body}\n}};")
        memories = np.cumsum([0, *map(_memory, self.parts.chain.watches)]).tolist()
        tables.text(
            f"static const uint32_t memory_from[{len(rows)}] = {{{', '.join(f'{m}u' for m in memories[:-1])}}};"
        )
        first = 1 + (self.parts.each + 1) * len(self.parts.residuals)
        starts = first + np.cumsum([0, *map(_watch_slices, self.parts.chain.watches)])
        slice_text = ", ".join(f"{start}u" for start in starts.tolist())
        tables.text(f"static const uint32_t slices_from[{len(starts)}] = {{{slice_text}}};")

    def _enter_scalars(self, tables: MonitorTables) -> None:
        chain = self.parts.chain
        scalars = {
            "IMPOSSIBLE": chain.impossible,
            "POINT_LIMIT": chain.point_limit,
            "CLIP": chain.clip,
            "GROSS": chain.gross,
            "DRIFT_STEP": chain.drift_step,
            "DRIFT_MOST": chain.drift_most,
            "ALARM_LIMIT": chain.limit,
            "QUIET": chain.quiet,
        }
        for name, value in scalars.items():
            tables.text(f"#define {name} {double_number(value)}")
        tables.text(f"#define POINTS {self.parts.points}u")
        tables.text(f"#define BLOCK_S {number(chain.block / self.parts.rate_hz)}")

    def _fill_template(self, template: str) -> Code:
        return fill(_own(f"templates/{template}"), self._values())

    def _values(self) -> dict[str, object]:
        parts, chain = self.parts, self.parts.chain
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
            "crc": self.tables.crc,
            "rate": number(parts.rate_hz),
            "rate_hz": f"{parts.rate_hz:g}",
            "tick_ms": f"{1000 / parts.rate_hz:g}",
            "block": chain.block,
            "block_s": f"{chain.block / parts.rate_hz:g}",
            "settle": chain.settle,
            "hold": HOLD_TICKS,
            "limit": f"{chain.impossible:.0f}",
            "inputs": len(parts.inputs),
            "residuals": len(parts.residuals),
            "each": parts.each,
            "drivers": len(chain.drivers),
            "levels": len(chain.level),
            "moving": len(chain.moving),
            "points": max(1, parts.points),
            "watches": len(chain.watches),
            "widest": max(watch.directions for watch in chain.watches),
            "memory": sum(map(_memory, chain.watches)),
            "slices": self.slices,
            "slices_per_tick": -(-self.slices // chain.block),
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
        chain = self.parts.chain
        summaries, points = self.parts.summaries, self.parts.points
        tick = (
            (14 + 5 * len(chain.drivers)) * len(chain.scale)
            + 2 * len(chain.centre)
            + len(chain.level)
            + len(chain.moving)
        )
        white = sum(2 * watch.matrix.size + 5 * _memory(watch) for watch in chain.watches)
        return tick + round((summaries * (4 * points + 12) + white) / chain.block)

    def _enums(self) -> dict[str, Code]:
        upper, parts = self.name.upper(), self.parts
        most = C_SIGNIFICANT - len(f"{upper}_RES_")
        inputs = zip(c_names((c.name for c in si_channels(parts.inputs)), most), parts.inputs, strict=True)
        residuals = zip(c_names(parts.residuals, most), parts.residuals, strict=True)
        watches = enumerate(parts.chain.watches)
        return {
            "input_enum": Code(
                "\n".join(
                    f"    {upper}_IN_{own} = {i}, /* {c_comment('; '.join((channel.unit, channel.description)))} */"
                    for i, (own, channel) in enumerate(inputs)
                )
            ),
            "residual_enum": Code(
                "\n".join(
                    f"    {upper}_RES_{own} = {i}, /* {c_comment(text)} */" for i, (own, text) in enumerate(residuals)
                )
            ),
            "watch_enum": Code(
                "\n".join(
                    f"    {upper}_STAT_{i} = {i}, /* {watch.detector}, {watch.directions} directions */"
                    for i, watch in watches
                )
            ),
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


def _memory(watch: WatchPart) -> int:
    return watch.directions * watch.rows


def _watch_slices(watch: WatchPart) -> int:
    """Return the number of calls of `edp_watch_part`: centring, whitening and detector steps."""
    detector = len(pieces(watch.directions, PIECE)) * watch.passes
    white = len(pieces(watch.directions, ROW)) if watch.own else watch.directions
    return len(pieces(len(watch.mean), ROW)) + white + detector


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
    _check_detectors(parts.chain.watches)
    memory = sum(map(_memory, parts.chain.watches))
    check_sizes({"bytes of the detectors' memory": 8 * memory, "ticks of a block": parts.chain.block}, MOST_MEMORY)
    sources = tuple(source_code(part, index, name) for index, part in enumerate(parts.sources))
    files = MonitorFiles(name, parts, sources)
    return files


def _check_detectors(watches: Sequence[WatchPart]) -> None:
    for watch in watches:
        if watch.detector not in DETECTORS:
            raise ExportError(
                f"detector '{watch.detector}' has no form in C, since it needs exponentials; these have: "
                f"{', '.join(DETECTORS)}. Fit the monitor with one of them"
            )


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


def _own(path: str) -> str:
    return resources.files("edp.export.monitor").joinpath(path).read_text(encoding="utf-8")
