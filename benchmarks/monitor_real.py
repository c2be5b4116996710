"""Does the monitor find real faults, and faults of sensors laid over real recordings, beside its rivals?

a) The hydraulic rig of UCI 447 (Helwig et al. 2015): cycles of 60 s with graded faults of cooler, valve, pump and
accumulator. Fitted to stable healthy cycles alone; of these there are ten, in one stretch of ten minutes. They are held
out in blocks of two; area under the detection curve of each grade (cycles in which nothing else is wrong) against them.
Ten cycles cannot show 1 % false alarms: what is found is told at the highest score of a held-out healthy one. All
grades stand hours away from the healthy stretch, so that a detector of *other times* would score as high as one of
faults. Therefore a control: the area against the eleven healthy cycles of two other times, which are marked as not yet
stable. A detector that tells faults from other times has a high area there, too.

b) Public recordings (`examples/real`): the first 60 % are healthy logs, in the rest one channel gets an offset, a wrong
scale, noise, a delay, or stays. The promise is what the healthy part supports.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as parquet
from numpy.typing import NDArray

from common import EXAMPLES, SHARED, Bench, benchmark, option, table
from edp.config.monitor import load_monitor_experiment
from edp.errors import DataError
from edp.logs.source import DataSource
from edp.monitor.detectors import EwmaSpec, statistics
from edp.monitor.fitting import ChainSpec, fit_from_blocks
from edp.monitor.monitor import Monitor
from edp.monitor.residuals.base import FitMaterial
from edp.monitor.residuals.cycles import CyclesSpec
from edp.monitor.session_blocks import blocks_of, fit_summaries
from edp.monitor.watches import WatchSpec
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.monitor import fit_to_recordings
from monitor_metrics import area_under_curve
from monitor_rivals import CHARTS, PYOD, Rival, has_pyod, limit_of, raised, rivals_of

Values = NDArray[np.float32]
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
        """Return a cycle as a recording."""
        channels = tuple(Channel(name, KINDS.get(name[0], Kind.GENERIC)) for name in self.sensors)
        return Recording(f"cycle_{cycle:04d}", channels, np.ascontiguousarray(self.values[cycle]), 1.0, "rig")


def read_rig(path: Path) -> Rig:
    """Read the rig's Parquet file."""
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
    """Return the largest statistic of the monitor's parts in a cycle.

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
    """Return the largest whitened row of a cycle, in blocks of ten seconds."""
    rival.fit([rig.values[i] for i in training], ticks=10)
    return lambda cycle: float(np.linalg.norm(rival.rows(rig.values[cycle]), axis=1).max())


def rig_results(rig: Rig, seed: int, quick: bool) -> dict[str, Any]:
    """Areas of every detector: by fault and grade, and against the healthy cycles of other times."""
    stable, other = rig.healthy(True), rig.healthy(False)
    blocks = [stable[i : i + HELD_OUT] for i in range(0, len(stable), HELD_OUT)]
    makers: dict[str, Callable[[Sequence[int]], Score]] = {"edp.monitor": lambda some: our_score(rig, some, seed)}
    names = list(rivals_of(tuple(PYOD) if has_pyod() else ()))
    for name in names:
        makers[name] = lambda some, name=name: rival_score(rig, some, rivals_of(tuple(PYOD))[name])
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


SETS = ("faster", "hanging_load", "motor", "cylinders", "sjoberg")
"""Those in which one channel follows from others at the same time: of the axis EMPS and of the tanks only the input is
measured beside the integral of what it does."""
BLOCK_TICKS, MEMORY_BLOCKS = 10, 2
SPANS_TICKS = (1, 2, 4, 8, 16, 32)
QUICK_SETS = ("cylinders", "sjoberg")
COMMANDS = ("u", "valve", "current", "reference", "r0", "r1")
"""Columns that no sensor shows."""
MINUTES = 0.3
"""Processor time of the networks of a monitor here: there are minutes of data."""
HEALTHY_SHARE, SEGMENTS, ONSET = 0.6, 3, 1 / 3
SIZES: Mapping[str, tuple[float, ...]] = {
    "bias": (0.1, 0.3, 1.0),
    "scale": (0.05, 0.2, 0.5),
    "noise": (0.1, 0.3, 1.0),
    "delay": (2.0, 10.0, 50.0),
    "stuck": (1.0,),
}
"""Offset and noise in deviations of the channel, scale as a share, delay in ticks."""


def injected(values: Values, column: int, kind: str, size: float, onset: int, rng: np.random.Generator) -> Values:
    """Return a copy with a fault of one sensor, starting at a given sample.

    Args:
        values: shape (ticks, channels).
        column: of the sensor.
        kind: one of `SIZES`.
        size: see `SIZES`.
        onset: first tick with the fault.
        rng: of the noise.
    """
    changed = values.copy()
    shown, deviation = changed[onset:, column], float(values[:, column].std())
    if kind == "bias":
        shown += np.float32(size * deviation)
    elif kind == "scale":
        shown *= np.float32(1.0 + size)
    elif kind == "noise":
        shown += (size * deviation * rng.normal(size=len(shown))).astype(np.float32)
    elif kind == "delay":
        ticks = min(round(size), onset)
        changed[onset:, column] = values[onset - ticks : len(values) - ticks, column]
    else:
        changed[onset:, column] = values[onset, column]
    return changed


def short_settings(rate_hz: float) -> tuple[str, ...]:
    """Return settings of a monitor for minutes of logs instead of hours."""
    spans, block_s = [ticks / rate_hz for ticks in SPANS_TICKS], BLOCK_TICKS / rate_hz
    memory = f"memory_s={MEMORY_BLOCKS * block_s}"
    return (
        f'residuals=[{{kind="virtual_sensors", units=16, lags_s={spans}}}, {{kind="balances"}}]',
        f"chain.block_s={block_s}",
        "chain.settle_s=0.0",
        f'chain.watches=[{{detector={{kind="ewma", weight=0.5}}}}, {{detector={{kind="cusum"}}, {memory}}}]',
    )


def set_results(name: str, seed: int) -> dict[str, Any]:
    """Shares found of one set, by detector, kind and size, and false alarms."""
    recordings = DataSource.from_path(EXAMPLES / f"{name}.toml").read()
    healthy, test = divided(recordings)
    rate_hz = recordings[0].rate_hz
    hours = sum(part.duration_s for part in healthy) / 3600.0
    # Of what is left behind the residuals a fifth may be left out as doubtful.
    promised = 0.45 * hours
    detectors: dict[str, Any] = {}
    try:
        promise = {"hours_per_false_alarm": promised, "minutes": MINUTES, "seed": seed}
        monitor = fit_to_recordings(healthy, load_monitor_experiment(None, short_settings(rate_hz), promise)).monitor
        detectors["edp.monitor"] = lambda part: [alarm.raised_s for alarm in _alarms(monitor, part)]
    except DataError as error:
        print(f"{name}: the monitor refuses: {error}")
        detectors["edp.monitor"] = lambda part: []
    detectors |= rival_detectors(healthy, rate_hz, promised)
    channels = [name for name in recordings[0].channel_names if name not in COMMANDS]
    cases = list(cases_of(test, channels, seed))
    results: dict[str, Any] = {"hours": hours, "promised_hours": promised, "rate_hz": rate_hz, "cases": len(cases)}
    test_hours = sum(part.duration_s for part in test) / 3600.0
    for detector, run in detectors.items():
        count = sum(len(run(part)) for part in test)
        hits: dict[str, list[bool]] = {}
        for part, kind, size, onset_s in cases:
            hit = any(when > onset_s for when in run(part))
            hits.setdefault("all", []).append(hit)
            hits.setdefault(f"{kind} {size:g}", []).append(hit)
        shares = {key: float(np.mean(values)) for key, values in hits.items()}
        results[detector] = {"found": shares, "false_alarms": count, "test_hours": test_hours}
    return results


def _alarms(monitor: Monitor, recording: Recording) -> list[Any]:
    """Alarms; a log that is refused as that of another machine is one alarm at its end."""
    try:
        return list(monitor.run(recording))
    except DataError:
        return [_Refused(recording.duration_s)]


@dataclass(frozen=True)
class _Refused:
    raised_s: float


def divided(recordings: Sequence[Recording]) -> tuple[list[Recording], list[Recording]]:
    """Split each recording into its first part and segments of the remainder."""
    healthy, test = [], []
    for recording in recordings:
        cut = round(HEALTHY_SHARE * recording.samples)
        healthy.append(recording.rows(0, cut))
        edges = np.linspace(cut, recording.samples, SEGMENTS + 1).astype(int).tolist()
        test += [recording.rows(a, b) for a, b in itertools.pairwise(edges)]
    return healthy, test


def cases_of(test: Sequence[Recording], channels: Sequence[str], seed: int) -> Any:
    """Segments with a fault: the recording, the kind, the size and the onset."""
    rng = np.random.default_rng(seed)
    for part in test:
        onset = round(ONSET * part.samples)
        for channel in channels:
            for kind, sizes in SIZES.items():
                for size in sizes:
                    values = injected(part.values, part.index(channel), kind, size, onset, rng)
                    changed = Recording(part.name, part.channels, values, part.rate_hz, part.source)
                    yield changed, kind, size, onset / part.rate_hz


def rival_detectors(healthy: Sequence[Recording], rate_hz: float, promised: float) -> dict[str, Any]:
    """Rivals with the blocks of the monitor; two thirds of the healthy pieces fit, as many as of the monitor limit."""
    ticks = BLOCK_TICKS
    rate = rate_hz / ticks
    pieces = [piece for part in healthy for piece in np.array_split(part.values, 12)]
    learning, limiting = pieces[::3], [piece for i, piece in enumerate(pieces) if i % 3]
    made: dict[str, Any] = {}
    for name, rival in rivals_of(tuple(PYOD) if has_pyod() else ()).items():
        try:
            rival.fit(learning, ticks)
            rows = [rival.rows(piece) for piece in limiting]
        except (DataError, ValueError) as error:
            print(f"{name} is left out: {error}")
            continue
        for chart, spec in CHARTS.items():
            hours = sum(len(part) for part in rows) / rate / 3600.0
            limit = limit_of(spec, rows, rate, min(promised, hours)).limit
            made[f"{name}, {chart}"] = lambda part, rival=rival, spec=spec, limit=limit: raised(
                spec, limit, rival.rows(part.values), rate
            )
    return made


def show(bench: Bench, rig: dict[str, Any], sets: dict[str, Any]) -> None:
    """Tables and verdicts."""
    if rig:
        for what, title in (("area", "area under the detection curve"), ("found", "found at no false alarm"),
                            ("control", "area against healthy cycles of other times")):  # fmt: skip
            print(f"\nrig: {title}")
            keys = list(next(iter(rig.values()))[what])
            table(["detector", *keys], [[name, *(row[what][key] for key in keys)] for name, row in rig.items()])
        for fault, goal in GOALS.items():
            # An area that healthy cycles of other times reach, too, shows the time of recording, not the fault.
            ours = min(lowest(rig["edp.monitor"][what], fault) for what in ("area", "control"))
            name = f"rig, {fault}: lowest AUC of a severity, healthy cycles of equal and other times"
            bench.check(name, ours, goal, ">= 1", "area")
    for name, row in sets.items():
        detectors = [key for key in row if isinstance(row[key], dict)]
        keys = list(row["edp.monitor"]["found"])
        print(f"\n{name}: {row['hours']:.3f} h healthy, one false alarm in {row['promised_hours']:.3f} h promised")
        lines = [
            [d, row[d]["false_alarms"], row[d]["test_hours"], *(row[d]["found"][k] for k in keys)] for d in detectors
        ]
        table(["detector", "false", "hours", *keys], lines)
        allowed = max(1.0, row["edp.monitor"]["test_hours"] / row["promised_hours"])
        # A rival that breaks its promise here is not at this rate.
        kept = [d for d in detectors[1:] if row[d]["false_alarms"] <= allowed]
        # Where no rival keeps the rate: one case.
        best = max((row[d]["found"]["all"] for d in kept), default=1.0 / row["cases"])
        ours = row["edp.monitor"]
        bench.check(f"{name}: faults found against the best detector", ours["found"]["all"], best, ">= 1", "share")
        bench.check(f"{name}: false alarms", float(ours["false_alarms"]), allowed, "<= 1", "alarms")


@benchmark(SHARED, option("--sets", nargs="*", help="recordings of part b; none: leave it out"))
def main(bench: Bench) -> object:
    file = bench.options.shared / "hydraulic_condition_uci" / "condition_1hz.parquet"
    rig = rig_results(read_rig(file), bench.seed, bench.quick) if file.exists() else {}
    sets = {}
    for name in bench.options.sets if bench.options.sets is not None else (QUICK_SETS if bench.quick else SETS):
        sets[name] = set_results(name, bench.seed)
        print(f"{name}: {sets[name]['cases']} cases done", flush=True)
    show(bench, rig, sets)
    return {"rig": rig, "sets": sets}


if __name__ == "__main__":
    main()
