"""``edp export MONITOR``: a fitted monitor as C99 without heap, with its networks and a self-test, and around that."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from edp.errors import ConfigError, ExportError, closest, count_of
from edp.evaluation.monitor_footprint import MonitorFootprint, monitor_footprint
from edp.export.golden import grown_tolerance, relax_at_thresholds, stream, tolerance
from edp.export.monitor import (
    GoldenChain,
    GoldenResiduals,
    MonitorParts,
    NetworkPart,
    SourcePart,
    TwinPart,
    drawn_rows,
    write_monitor,
    write_monitor_fmu,
    write_monitor_ros2,
)
from edp.monitor.chain import MonitorChain
from edp.monitor.monitor import Monitor
from edp.monitor.monitor_file import HEADER, load_monitor
from edp.monitor.residuals.balances import Balances
from edp.monitor.residuals.base import ResidualSource
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.residuals.look_ahead import SMALLEST_WIDTH, LookAhead
from edp.monitor.residuals.twin_ports import TwinPorts
from edp.monitor.residuals.virtual_sensors import VirtualSensors
from edp.networks.integer import IntegerPredictor
from edp.networks.twin import IntegerTwinPlant, TwinPlant
from edp.storage.paths import is_file_at
from edp.training.bundle import Bundle
from edp.training.twin_bundle import plant_bundle

FORMS: Mapping[str, tuple[str, ...]] = {"c": (), "fmu": ("version", "binaries"), "ros2": ()}
"""Forms of a monitor with their options; they are forms of networks, too."""
GOLDEN_TICKS = 120
"""Length of the residuals' self-test: more than a window, with samples whose inputs are missing."""
ROUNDING = 2.0**-22
"""Relative rounding error of the difference between a measured value and its prediction."""
Rows = NDArray[np.float32]
NO_CHAIN = GoldenChain(np.zeros((0, 0)), (), (), np.zeros(0))
NO_RESIDUALS = GoldenResiduals(*(np.zeros((0, 0), np.float32),) * 2, np.zeros(0, np.float32))


def holds_monitor(path: str | Path) -> bool:
    """Return whether a folder is one that edp monitor fit wrote."""
    return is_file_at(Path(path) / HEADER)


def export_monitor(
    monitor: str | Path, to: str, folder: str | Path, name: str, options: Mapping[str, str] | None = None
) -> list[Path]:
    """Write a fitted monitor in the form `to`.

    Args:
        monitor: folder that edp monitor fit wrote.
        to: a name of `FORMS`.
        folder: output folder.
        name: name of the monitor in the files.
        options: options of the form.

    Returns:
        The files, the one to read first in front.

    Raises:
        EdpError: not a monitor, a part without a form in C, a form, a name or an option that cannot be.
    """
    if to not in FORMS:
        raise ExportError(f"a monitor has no form '{to}'{closest(to, FORMS)}; it has {', '.join(FORMS)}")
    accepted = FORMS[to]
    for option in options or {}:
        if option not in accepted:
            has = f"it has {', '.join(accepted)}" if accepted else "it has none"
            raise ConfigError(f"--set {option}: form '{to}' of a monitor has no such option ({has}); leave it out")
    parts = monitor_parts(load_monitor(monitor))
    if to == "fmu":
        return write_monitor_fmu(parts, name, Path(folder), dict(options or {}))
    return (write_monitor_ros2 if to == "ros2" else write_monitor)(parts, name, Path(folder))


def monitor_footprint_of(monitor: str | Path) -> MonitorFootprint:
    """Return the memory and time of a fitted monitor on a controller.

    Raises:
        EdpError: not a monitor, or a part without a form in C.
    """
    return monitor_footprint(monitor_parts(load_monitor(monitor), golden=False))


def monitor_parts(monitor: Monitor, golden: bool = True) -> MonitorParts:
    """Return the exported parts of a monitor, and the expected values of its self-test.

    Args:
        monitor: fitted.
        golden: whether there will be a self-test; else nothing is run.

    Raises:
        ExportError: a source or a detector without a form in C.
    """
    columns = _places(monitor)
    sources = tuple(part for source in monitor.sources for part in source_parts(source, columns))
    chain = monitor.chain
    parts = MonitorParts(
        title=f"monitor of {count_of(len(monitor.inputs), 'channel')}",
        digest=str(monitor.provenance.get("digest", "")) or digest_of(chain),
        promise=f"{monitor.limit.sentence()}.",
        inputs=monitor.channels,
        rate_hz=monitor.rate_hz,
        residuals=monitor.residual_names,
        reads=[tuple(columns[n] for n in reads) for source in monitor.sources for reads in source.reads],
        columns=columns,
        sources=sources,
        chain=chain,
        golden_chain=NO_CHAIN,
        golden_residuals=NO_RESIDUALS,
    )
    # Refused before the self-test is run: a detector without a form in C.
    if parts.watches and golden:
        return replace(parts, golden_chain=golden_chain(chain), golden_residuals=golden_residuals(monitor))
    return parts


def digest_of(chain: MonitorChain) -> str:
    """Return content address of a chain."""
    import hashlib

    state = hashlib.blake2b(digest_size=16)
    for watch in chain.watches:
        state.update(watch.matrix.astype("<f8").tobytes() + watch.mean.astype("<f8").tobytes())
    summaries, conditioning = chain.summaries, chain.conditioning
    for values in (summaries.centre, summaries.spread, summaries.scale, conditioning.usual, conditioning.spread):
        state.update(np.ascontiguousarray(values).astype("<f8").tobytes())
    return state.hexdigest()


# ---- sources ---------------------------------------------------------------------------------------------------------


def source_parts(source: ResidualSource, columns: Mapping[str, int]) -> list[SourcePart]:
    """Return a source as parts with residuals in its order.

    Raises:
        ExportError: it has no form in C.
    """
    if isinstance(source, VirtualSensors):
        return [_virtual(source, number, columns) for number in range(len(source.bundles))]
    if isinstance(source, LookAhead):
        return [_look_ahead(source, bundle, columns) for bundle in source.bundles.values()]
    if isinstance(source, TwinPorts):
        return [_twin(source, columns)]
    if isinstance(source, Balances | FlowBalances):
        return [source]
    raise ExportError(
        f"residuals of kind '{type(source).__name__}' have no form in C; fit the monitor without them, or run it in "
        "Python"
    )


def _virtual(source: VirtualSensors, number: int, columns: Mapping[str, int]) -> NetworkPart:
    own, bundle = {name: i for i, name in enumerate(source.inputs)}, list(source.bundles.values())[number]
    reads, targets = bundle.task.inputs, bundle.task.targets
    return NetworkPart(
        bundle=bundle,
        reads=tuple(columns[name] for name in reads),
        middle=source.middle[[own[name] for name in reads]],
        judged=tuple(columns[name] for name in targets),
        results=tuple(range(len(targets))),
        delays=(0,) * len(targets),
        every=source.every,
        first=number % source.every,
    )


def _look_ahead(source: LookAhead, bundle: Bundle, columns: Mapping[str, int]) -> NetworkPart:
    own = {name: i for i, name in enumerate(source.inputs)}
    reads, task = bundle.task.inputs, bundle.task
    logged = [i for i, target in enumerate(task.targets) if target in own]
    return NetworkPart(
        bundle=bundle,
        reads=tuple(columns[name] for name in reads),
        middle=source.middle[[own[name] for name in reads]],
        judged=tuple(columns[task.targets[i]] for _ in task.horizons for i in logged),
        results=tuple(h * len(task.targets) + i for h in range(len(task.horizons)) for i in logged),
        delays=tuple(k for k in task.horizons for _ in logged),
        scaled=bool(bundle.predictor.output.coverages),
        least_width=SMALLEST_WIDTH,
    )


def _twin(source: TwinPorts, columns: Mapping[str, int]) -> TwinPart:
    channels = source.bundle.twin.channels
    own = {name: i for i, name in enumerate(source.inputs)}
    reads = [channel.name for channel in (*channels.commands, *channels.answers)]
    answers = {channel.name: i for i, channel in enumerate(channels.answers)}
    return TwinPart(
        bundle=plant_bundle(source.bundle),
        reads=tuple(columns[name] for name in reads),
        middle=source.middle[[own[name] for name in reads]],
        groups=tuple(tuple(answers[name] for name in group) for group in source.groups),
        prefix=source.bundle.twin.prefix_ticks,
        period=source.period,
    )


# ---- self-test -------------------------------------------------------------------------------------------------------


def golden_chain(chain: MonitorChain) -> GoldenChain:
    """Return the results of the chain for plotted rows."""
    inputs, residuals = drawn_rows(chain)
    verdicts, _ = chain.run(residuals, inputs, chain.initial_state())
    last = [verdict.evidence for verdict in verdicts if verdict.alarm is not None]
    return GoldenChain(
        statistics=np.array([verdict.statistics for verdict in verdicts]),
        alarms=tuple(-1 if verdict.alarm is None else verdict.alarm for verdict in verdicts),
        since=tuple(verdict.since for verdict in verdicts),
        evidence=last[-1] if last else np.zeros(chain.summaries.width),
    )


def golden_residuals(monitor: Monitor) -> GoldenResiduals:
    """Return smooth inputs in the normal range, some of them missing, and their residuals."""
    summaries = monitor.chain.summaries
    rng = np.random.default_rng(0)
    value, rows = rng.normal(size=len(monitor.inputs)), []
    for kick in rng.normal(size=(GOLDEN_TICKS, len(monitor.inputs))):
        value = 0.9 * value + 0.4 * kick
        rows.append(summaries.centre + value / summaries.spread)
    inputs = np.asarray(rows, np.float32)
    holes = rng.random(inputs.shape) < 0.05
    holes[: GOLDEN_TICKS // 2] = False
    inputs[holes] = np.nan
    residuals, _ = monitor.residuals(inputs, monitor.initial_state())
    allowed_by, first = np.zeros(residuals.shape[1]), 0
    filled = _fill_missing(inputs, summaries.centre)
    for part in (part for source in monitor.sources for part in source_parts(source, _places(monitor))):
        allowed = _compute_tolerance(part, filled)
        allowed_by[first : first + len(allowed)] = allowed
        first += len(allowed)
    return GoldenResiduals(inputs, residuals, allowed_by.astype(np.float32))


def _places(monitor: Monitor) -> dict[str, int]:
    return {name: i for i, name in enumerate(monitor.inputs)}


def _fill_missing(rows: Rows, start: NDArray[np.float64]) -> Rows:
    """Return rows with missing values replaced by the last value."""
    filled, last = rows.copy(), start.astype(np.float32)
    for row in filled:
        row[:] = last = np.where(np.isfinite(row), row, last)
    return filled


def _compute_tolerance(part: SourcePart, rows: Rows) -> NDArray[np.float64]:
    """Return the tolerance of residuals in C: the tolerance of the network; zero for sums and integers."""
    if isinstance(part, Balances | FlowBalances):
        return np.zeros(len(part.names))
    if isinstance(part, TwinPart):
        return _compute_twin_tolerance(part, rows)
    network, ran = part.bundle.predictor, rows[part.first :: part.every]
    fed, judged = ran[:, part.reads], ran[:, part.judged]
    outputs = stream(network, fed)
    # A predictor whose trees may take another leaf there is off by a step.
    off = (tolerance(network, fed, outputs) + relax_at_thresholds(network, fed).max(axis=0)).astype(np.float64)
    results, count = np.asarray(part.results), len(part.bundle.task.targets) * len(part.bundle.task.horizons)
    whole = not isinstance(network, IntegerPredictor)
    apart = off[results] + whole * ROUNDING * np.abs(judged).max(axis=0)
    if not part.scaled:
        return np.asarray(apart)
    # Bounds stand behind the predictions, lower ones first; the first interval is the scale.
    upper = results + count * (1 + len(part.bundle.predictor.output.coverages))
    lower = results + count
    half = np.maximum(0.5 * (outputs[:, upper] - outputs[:, lower]), part.least_width).astype(np.float64)
    largest = np.abs(judged - outputs[:, results]).max(axis=0) + 2.0 * np.ptp(judged, axis=0)
    width = half.min(axis=0)
    return np.asarray((apart + largest / width * 0.5 * (off[upper] + off[lower])) / width)


def _compute_twin_tolerance(part: TwinPart, rows: Rows) -> NDArray[np.float64]:
    """Return the growth of single-precision errors while ports are free, group by group."""
    plant, fed = part.bundle.predictor, rows[:, part.reads]
    if not isinstance(plant, TwinPlant):
        raise ExportError("residuals with free ports need a twin; fit the monitor again")
    commands, answers = plant.sizes[:2]
    ticks, allowed = np.arange(len(rows)), []
    apart = (ticks >= part.prefix) & ((ticks - part.prefix) % part.period != 0)
    for group in part.groups:
        flags = np.ones((len(rows), answers), np.float32)
        flags[np.ix_(apart, group)] = 0.0
        measured = fed[:, commands:] * flags
        inputs = np.concatenate([fed[:, :commands], measured, flags], axis=1)
        outputs = stream(plant, inputs)
        if isinstance(plant, IntegerTwinPlant):
            allowed.append(np.zeros(len(group)))
            continue
        off = grown_tolerance(plant, inputs, outputs).max(axis=0).astype(np.float64)
        allowed.append(off[list(group)] + ROUNDING * np.abs(fed[:, commands:]).max(axis=0)[list(group)])
    return np.concatenate(allowed)
