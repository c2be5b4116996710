"""The hydraulic rig of UCI 447: its cycles, and how far each lies from healthy ones for a monitor and its rivals."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
from numpy.typing import NDArray

from edp.errors import DataError
from edp.monitor.detectors import EwmaSpec, statistics
from edp.monitor.fitting import ChainSpec, fit_from_blocks
from edp.monitor.residuals.base import FitMaterial
from edp.monitor.residuals.cycles import CyclesSpec
from edp.monitor.session_blocks import blocks_of, fit_summaries
from edp.monitor.watches import WatchSpec
from edp.recording import Recording
from edp.signals import Channel, Kind
from monitor_metrics import area_under_curve
from monitor_rivals import Rival, has_pyod, rivals_of

Values = NDArray[np.float32]
BEST_PYOD = ("CBLOF", "GMM")
RIG_CYCLES = CyclesSpec()
"""Each log is a cycle of the rig, which repeats it second by second."""
RIG_CHAIN = ChainSpec(settle_s=0.0, clip=1000.0, folds=4, doubtful=1e6, watches=(WatchSpec(detector=EwmaSpec()),))
"""Without bounds that need hours of healthy work: what is far off is to be as far off as it is."""
CONDITIONS = {"cooler_percent": 100, "valve_percent": 100, "pump_leak": 0, "accumulator_bar": 130}
"""Columns of the rig with the value of the sound part."""
GOALS = {"cooler_percent": 0.99, "valve_percent": 0.95, "pump_leak": 0.9, "accumulator_bar": 0.9}
CYCLE_S, HELD_OUT = 60, 2
KINDS = {"P": Kind.PRESSURE, "F": Kind.FLOW, "T": Kind.TEMPERATURE}
"""By the first letter of a sensor's name; all others are plain numbers."""


@dataclass(frozen=True, eq=False)
class Rig:
    """The cycles of the rig.

    Attributes:
        values: shape (cycles, seconds, sensors).
        sensors: their names.
        conditions: of each cycle, by column.
        stable: whether conditions were static.
    """

    values: Values
    sensors: tuple[str, ...]
    conditions: dict[str, NDArray[np.int64]]
    stable: NDArray[np.bool_]

    def healthy(self, stable: bool) -> NDArray[np.int64]:
        """Cycles with nothing wrong."""
        sound = np.all([self.conditions[name] == good for name, good in CONDITIONS.items()], axis=0)
        return np.flatnonzero(sound & (self.stable == stable))

    def grades(self) -> dict[tuple[str, int], NDArray[np.int64]]:
        """Stable cycles with one fault alone, by its column and grade."""
        found = {}
        for name, good in CONDITIONS.items():
            others = [self.conditions[other] == value for other, value in CONDITIONS.items() if other != name]
            alone = np.all(others, axis=0) & self.stable
            for grade in sorted(set(self.conditions[name].tolist()) - {good}):
                found[name, grade] = np.flatnonzero(alone & (self.conditions[name] == grade))
        return found

    def recording(self, cycle: int) -> Recording:
        """A cycle as a log."""
        channels = tuple(Channel(name, KINDS.get(name[0], Kind.GENERIC)) for name in self.sensors)
        return Recording(f"cycle_{cycle:04d}", channels, np.ascontiguousarray(self.values[cycle]), 1.0, "rig")


def read_rig(path: Path) -> Rig:
    """The rig's Parquet file."""
    columns = parquet.read_table(path).to_pydict()
    beside = {"cycle", "second", "stable_flag", *CONDITIONS}
    sensors = tuple(name for name in columns if name not in beside)
    values = np.stack([np.array(columns[name], np.float32) for name in sensors], axis=1)
    each = {name: np.array(columns[name]).reshape(-1, CYCLE_S)[:, 0] for name in (*CONDITIONS, "stable_flag")}
    stable = each.pop("stable_flag") == 0
    return Rig(values.reshape(-1, CYCLE_S, len(sensors)), sensors, each, stable)


Score = Callable[[int], float]
"""Of a cycle, large for a fault."""


def our_score(rig: Rig, training: Sequence[int], seed: int) -> Score:
    """The largest statistic of the monitor's parts in a cycle.

    `edp.workflows.monitor` refuses logs of ten minutes; here its parts are put together without an operating point, for
    which there are too few blocks. Every other cycle tells what is expected at each second, the rest sets scales and
    covariance.
    """
    sessions = [rig.recording(i) for i in training]
    channels = sessions[0].channels
    source = RIG_CYCLES.fit(FitMaterial(sessions[2::2], sessions[:1], channels, 1.0, seed=seed))
    if source is None:
        raise DataError("no sensor of the rig changes")
    rest = sessions[1::2]
    summaries = fit_summaries(RIG_CHAIN.block_s, (source,), channels, rest)
    summaries = replace(summaries, moving=summaries.moving[:0], level=summaries.level[:0])
    parts = [blocks_of(summaries, (source,), channels, session) for session in rest]
    # The limit is not used: areas compare statistics.
    hours = sum(session.duration_s for session in rest) / 3600.0
    chain = fit_from_blocks(RIG_CHAIN, summaries, parts, 1.0, 0, 0.9 * hours).chain

    def score(cycle: int) -> float:
        part = blocks_of(summaries, (source,), channels, rig.recording(cycle))
        gross = chain.conditioning.unclipped(part.summaries, part.points)
        white = chain.bank.white(chain.conditioning(part.summaries, part.points), gross)
        return float(statistics(chain.bank.build(white.shape[1]), white[:, None]).max())

    return score


def rival_score(rig: Rig, training: Sequence[int], rival: Rival) -> Score:
    """The longest white row of a cycle, blocks of ten seconds."""
    rival.fit([rig.values[i] for i in training], ticks=10)
    return lambda cycle: float(np.linalg.norm(rival.rows(rig.values[cycle]), axis=1).max())


def rig_results(rig: Rig, seed: int, quick: bool) -> dict[str, Any]:
    """Areas of every detector: by fault and grade, and against the healthy cycles of other times."""
    stable, other = rig.healthy(True), rig.healthy(False)
    blocks = [stable[i : i + HELD_OUT] for i in range(0, len(stable), HELD_OUT)]
    makers: dict[str, Callable[[Sequence[int]], Score]] = {"edp.monitor": lambda some: our_score(rig, some, seed)}
    names = list(rivals_of(BEST_PYOD if has_pyod() else ()))
    for name in names:
        makers[name] = lambda some, name=name: rival_score(rig, some, rivals_of(BEST_PYOD)[name])
    results: dict[str, Any] = {}
    for name, make in makers.items():
        began = time.process_time()
        results[name] = _areas(rig, make, blocks[:1] if quick else blocks, stable, other)
        results[name]["processor_s"] = time.process_time() - began
        print(f"rig: {name} done in {results[name]['processor_s']:.0f} processor s", flush=True)
    return results


def _areas(
    rig: Rig,
    make: Callable[[Sequence[int]], Score],
    blocks: Sequence[NDArray[np.int64]],
    stable: NDArray[np.int64],
    other: NDArray[np.int64],
) -> dict[str, Any]:
    grades = rig.grades()
    areas: dict[tuple[str, int], list[float]] = {key: [] for key in grades}
    found: dict[tuple[str, int], list[float]] = {key: [] for key in grades}
    for block in blocks:
        score = make([i for i in stable.tolist() if i not in block])
        calm = np.array([score(i) for i in block.tolist()])
        for key, cycles in grades.items():
            wrong = np.array([score(i) for i in cycles.tolist()])
            areas[key].append(area_under_curve(calm, wrong))
            found[key].append(float((wrong > calm.max()).mean()))
    score = make(stable.tolist())
    calm = np.array([score(i) for i in other.tolist()])
    control = {
        key: area_under_curve(calm, np.array([score(i) for i in cycles.tolist()])) for key, cycles in grades.items()
    }
    return {
        "area": {f"{name} {grade}": float(np.mean(areas[name, grade])) for name, grade in grades},
        "found": {f"{name} {grade}": float(np.mean(found[name, grade])) for name, grade in grades},
        "control": {f"{name} {grade}": control[name, grade] for name, grade in grades},
    }


def lowest(result: Mapping[str, float], fault: str) -> float:
    """Of all grades of a fault."""
    return min(value for key, value in result.items() if key.startswith(fault))
