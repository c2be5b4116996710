"""Cost of an exported monitor: its networks like predictors, and the chain in double precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass

from edp.evaluation.controller import BOARD_SLOW, BOARD_TYPICAL, CORES, STACK_BYTES, Budget, Estimate, LimitCheck
from edp.evaluation.footprint import Footprint, footprint
from edp.export.monitor import MonitorParts, NetworkPart, TwinPart, WatchCode, monitor_files
from edp.export.monitor.parts import PIECE, ROW, pieces
from edp.networks.integer import IntegerPredictor
from edp.networks.twin import TwinPlant
from edp.settings.results import plain_value

CORE_COSTS = {
    "residual": 1_650.0,
    "driver": 490.0,
    "input": 155.0,
    "product": 8.0,
    "double": 188.0,
    "summary": 1_000.0,
    "tick": 500.0,
}
"""Cycles of a Cortex-M4F with zero-wait memory and software double precision.

Cycles per sample of a residual, of its driver and of an input; cycles of a product with its sum in single and in double
precision; cycles of a residual's summary at the end of a block, and of a sample. Fitted to instruction counts of chains
of several sizes (``benchmarks/monitor_cycles.py --fit``).
"""
FLOW_COSTS = {"path": 110.0, "chamber": 450.0, "spool": 160.0}
"""Cycles per sample of flow balances in single precision: of a flow path (knot search, two square roots and a division
at 14 cycles each), of a chamber and of a spool. Counted by hand from the operations of the code, unlike `CORE_COSTS`.
"""
DETECTOR = {"cusum": 2.0, "ewma": 2.5, "glr": 2.0, "separate_cusums": 2.5}
"""Equivalent number of double-precision products per direction in a detector; per window length for the likelihood
ratio.
"""
CENTRE, VERDICT, POINT = 0.5, 0.6, 4.0
"""Cycles per summary centred for a watch, per summary in a verdict, and per value of the operating point."""
CHAIN_PROGRAM_BYTES = 9_000
"""Program size in bytes of the monitor chain, its runtime and the double-precision library on a Cortex-M4F."""


@dataclass(frozen=True)
class ChainCycles:
    """Cycles of a tick of a chain on a Cortex-M4F with zero-wait memory: on average, and in the longest tick."""

    mean: float
    most: float


def chain_work(parts: MonitorParts) -> dict[str, float]:
    """Return the average operations of the chain per sample, by the names of `CORE_COSTS`."""
    summaries, points = parts.chain.summaries, parts.points
    products = 2.0 * summaries.width * points + sum(view.watch.matrix.size for view in parts.watches)
    doubles = sum(map(_watch_doubles, parts.watches)) + VERDICT * summaries.width + POINT * points
    return {
        "residual": float(summaries.residuals),
        "driver": float(summaries.residuals * len(summaries.drivers)),
        "input": float(len(summaries.centre) + len(summaries.level) + len(summaries.moving)),
        "product": products / summaries.block,
        "double": doubles / summaries.block,
        "summary": summaries.width / summaries.block,
        "tick": 1.0,
    }


def _watch_doubles(view: WatchCode) -> float:
    summaries, directions = len(view.watch.mean), view.directions
    each = DETECTOR[view.detector] * (view.rows if view.detector == "glr" else 1)
    return float(CENTRE * summaries + each * directions)


def chain_cycles(parts: MonitorParts) -> ChainCycles:
    """Return the cycles of the chain of a monitor."""
    work, block = chain_work(parts), parts.chain.summaries.block
    flows = flow_cycles(parts)
    every = flows + sum(CORE_COSTS[name] * work[name] for name in ("residual", "driver", "input", "tick"))
    costs = _slices(parts)
    together = -(-len(costs) // block)
    most = max(sum(costs[first : first + together]) for first in range(0, len(costs), together))
    mean = flows + sum(CORE_COSTS[name] * amount for name, amount in work.items())
    return ChainCycles(mean, every + most)


def flow_cycles(parts: MonitorParts) -> float:
    """Return the cycles of the balances of flow of a monitor at a tick.

    They are counted with the chain, since no network runs.
    """
    cycles = 0.0
    for flows in parts.flows:
        paths = sum(len(chamber.values) for chamber in flows.chambers)
        cycles += FLOW_COSTS["path"] * paths + FLOW_COSTS["chamber"] * len(flows.chambers)
        cycles += FLOW_COSTS["spool"] * len(flows.spools.gain)
    return cycles


def _slices(parts: MonitorParts) -> list[float]:
    """Return the cycles of each part of the work on a block, in its order."""
    product, double, summaries = CORE_COSTS["product"], CORE_COSTS["double"], parts.chain.summaries.width
    costs = [POINT * double * parts.points]
    of_summary = 2.0 * product * parts.points + 6.0 * double
    costs += len(parts.residuals) * [parts.each * CORE_COSTS["summary"], *(parts.each * [of_summary])]
    for view in parts.watches:
        costs += [CENTRE * double * size for size in pieces(summaries, ROW)]
        if view.watch.own:
            costs += [product * size for size in pieces(view.directions, ROW)]
        else:
            costs += view.directions * [product * summaries]
        once = [double * size for size in pieces(view.directions, PIECE)]
        costs += [share * cycles for share in _shares(view) for cycles in once]
    return [*costs, 0.0, *(VERDICT * double * size for size in pieces(summaries, ROW))]


def _shares(view: WatchCode) -> list[float]:
    """Return the cost of each pass of a detector through its directions; the second CUSUM pass is one product."""
    each = DETECTOR[view.detector]
    return [0.75 * each, 0.25 * each] if view.detector == "cusum" else view.passes * [each]


@dataclass(frozen=True)
class NetworkCost:
    """A network of a monitor.

    Attributes:
        footprint: counts of the network.
        number_format: number format of the export.
        runs: number of evaluations per sample of the network.
        every: ticks from one of its ticks to the next.
        first: the first of them.
    """

    footprint: Footprint
    number_format: str
    runs: int = 1
    every: int = 1
    first: int = 0

    @property
    def estimate(self) -> Estimate:
        """Estimate of one run."""
        return self.footprint.estimate(self.number_format)

    def cycles(self, core: str) -> tuple[float, float, float]:
        """Return the low and typical estimates averaged over samples, and the high estimate of a single sample."""
        low, typical, high = self.estimate.cycles[core]
        return self.runs * low / self.every, self.runs * typical / self.every, self.runs * high


@dataclass(frozen=True)
class MonitorFootprint:
    """Resource usage of a monitor on a controller.

    Attributes:
        networks: each of them.
        chain: cycles behind the residuals.
        cycles: low, typical and high estimate of a tick by core; the high one decides and is that of the longest tick.
        constants: bytes in read-only memory.
        ram_bytes: state, working memory and stack.
        program_bytes: code, an estimate.
        state_bytes: state of the chain and of the sources without their networks, bytes.
    """

    networks: tuple[NetworkCost, ...]
    chain: ChainCycles
    cycles: dict[str, tuple[int, int, int]]
    constants: int
    ram_bytes: int
    program_bytes: int
    state_bytes: int

    def to_json(self, budget: Budget) -> dict[str, object]:
        """Return the plain values with the verdict against `budget`."""
        return {
            "networks": [
                {
                    "parameters": network.footprint.parameters,
                    "macs_tick": network.runs * network.footprint.macs_tick,
                    "number_format": network.number_format,
                    "runs": network.runs,
                    "every": network.every,
                }
                for network in self.networks
            ],
            "chain": asdict(self.chain),
            "cycles": {core: list(values) for core, values in self.cycles.items()},
            "constants": self.constants,
            "ram_bytes": self.ram_bytes,
            "program_bytes": self.program_bytes,
            "budget": asdict(budget),
            "verdict": plain_value(self.verdict(budget)),
        }

    def verdict(self, budget: Budget) -> list[LimitCheck]:
        """Return one row per limit, like `Footprint.verdict`."""
        low, typical, high = self.cycles[budget.core]
        text = f"high estimate of the longest tick; low {low:,}, typical {typical:,}"
        memory, flash = self.constants + self.ram_bytes, self.constants + self.program_bytes
        rows = [
            ("cycles per tick", high, budget.cycles, "cycles", text),
            ("parameters", self.constants, budget.parameter_bytes, "bytes", "all constants of the C code"),
            ("RAM", memory, budget.ram_bytes, "bytes", "constants too, as in the thesis"),
            ("flash", flash, budget.flash_bytes, "bytes", "estimate, with the program"),
        ]
        return [LimitCheck(what, value, limit, unit, value <= limit, note) for what, value, limit, unit, note in rows]


def monitor_footprint(parts: MonitorParts) -> MonitorFootprint:
    """Count the resource usage of a monitor as exported C code.

    Raises:
        ExportError: a part has no form in C.
    """
    files = monitor_files(parts, "monitor")
    networks = tuple(_network(part) for part in parts.sources if isinstance(part, NetworkPart | TwinPart))
    chain, state = chain_cycles(parts), chain_bytes(parts) + sum(source.bytes for source in files.sources)
    cycles = {}
    for name, core in CORES.items():
        low, typical, high = _network_cycles(networks, name)
        low, typical = low + chain.mean * core.low, typical + chain.mean * core.typical * BOARD_TYPICAL
        cycles[name] = (round(low), round(typical), round(high + chain.most * BOARD_SLOW))
    return MonitorFootprint(
        networks=networks,
        chain=chain,
        cycles=cycles,
        constants=files.tables.bytes + sum(one.estimate.parameter_bytes for one in networks),
        ram_bytes=STACK_BYTES + state + sum(one.runs * (one.estimate.ram_bytes - STACK_BYTES) for one in networks),
        program_bytes=CHAIN_PROGRAM_BYTES + sum(one.estimate.program_bytes for one in networks),
        state_bytes=state,
    )


def _network_cycles(networks: Sequence[NetworkCost], core: str) -> tuple[float, float, float]:
    """Return the cycles of all networks per sample: low and typical estimate as means, high estimate as a maximum.

    Cycles of networks that run in the same sample are added. For several periods, the worst samples are assumed to
    coincide.
    """
    low, typical, at_once = 0.0, 0.0, dict[tuple[int, int], float]()
    for network in networks:
        costs, turn = network.cycles(core), (network.every, network.first)
        low, typical = low + costs[0], typical + costs[1]
        at_once[turn] = at_once.get(turn, 0.0) + costs[2]
    periods = {every for every, _ in at_once}
    longest = [max(cycles for (every, _), cycles in at_once.items() if every == period) for period in periods]
    return low, typical, sum(longest)


def _network(part: NetworkPart | TwinPart) -> NetworkCost:
    network = part.bundle.predictor
    whole = isinstance(network, IntegerPredictor)
    counted = (
        network.to_float_network()
        if isinstance(network, IntegerPredictor) and not isinstance(network, TwinPlant)
        else network
    )
    form = "w8a16" if whole else "float32"
    if isinstance(part, TwinPart):
        return NetworkCost(footprint(counted), form, runs=len(part.groups))
    return NetworkCost(footprint(counted), form, every=part.every, first=part.first)


def chain_bytes(parts: MonitorParts) -> int:
    """Return the state size of the chain.

    It holds sums of two blocks, summaries, drift, evidence and detectors in double precision.
    """
    summaries, inputs, residuals = parts.chain.summaries, len(parts.inputs), len(parts.residuals)
    sums = (8 + 2 * len(summaries.drivers)) * residuals + len(summaries.level) + len(summaries.moving)
    detectors = sum(view.memory for view in parts.watches)
    widest, views = max(view.directions for view in parts.watches), len(parts.watches)
    doubles = 2 * sums + 5 * summaries.width + inputs + parts.points + widest + detectors + 3 * views + parts.each
    own = 8 * doubles + 4 * summaries.width + 5 * inputs + 4 * residuals + 4 * views + 80
    return int(own)
