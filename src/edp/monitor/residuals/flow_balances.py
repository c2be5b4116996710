"""Flow balances: flow into a cylinder chamber through its valve, compared with the piston velocity.

A spool follows its command; how far it opens and the pressures on both sides of it tell the flow, whatever load or soil
pushes. What is wrong with the valve, the seals, the oil, or one of the sensors leaves a rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from edp.monitor.residuals.base import (
    RESIDUALS,
    FitMaterial,
    ResidualSource,
    ResidualSpec,
    Rows,
    SourceParts,
    mean_inputs,
    source_arrays,
    texts_of,
)
from edp.monitor.residuals.flow_curves import (
    BACK,
    DOUBTS,
    KNOTS,
    LINES,
    ChamberPlaces,
    Singles,
    SpoolModel,
    doubts_of,
    lines_of,
    opened,
    opening_later,
    paths_of,
    slopes_of,
)
from edp.monitor.residuals.flow_fit import fit_chambers, fit_oil_range
from edp.recording import Recording
from edp.settings.bounds import MAX_ROWS, check_bounds, integer, span
from edp.signals import KINDS, Kind
from edp.storage.arrays import ArrayRule, arrays_under, checked_arrays
from edp.storage.reading import Table
from edp.wording import figure, percent

PREFIX = "flow:"
MAX_CHAMBERS, MAX_DEAD = 64, 1_000
"""Maximum numbers in a file: chambers, and samples of dead time."""
NUMBERS = {
    "values": ArrayRule(("paths", len(KNOTS)), np.float32),
    "slopes": ArrayRule(("paths", len(KNOTS)), np.float32),
    "lines": ArrayRule((LINES,), np.float32),
    "doubts": ArrayRule((DOUBTS,), np.float32, low=0.0),
}
"""Arrays of a chamber in a file."""
SPOOLS = {
    "extend": ArrayRule(("spools",), np.int64, low=0, high="inputs"),
    "retract": ArrayRule(("spools",), np.int64, low=-1, high="inputs"),
    "gain": ArrayRule(("spools",), np.float32),
    "dead": ArrayRule(("spools",), low=0.0, high=MAX_DEAD),
    "stages": ArrayRule(("spools", 2, 4), np.float32),
    "play": ArrayRule(("spools",), np.float32, low=0.0),
}
"""Arrays of `SpoolModel` in a file."""


@dataclass(frozen=True, eq=False)
class ChamberCurves:
    """Numbers of a chamber's balance.

    Attributes:
        spots: indices of its channels.
        values: values of its curves at the knots, shape (paths, knots).
        slopes: slopes of its curves after each knot, shape (paths, knots).
        lines: factors of the terms without a spool, shape (LINES,).
        doubts: factors of what makes it uncertain, none negative and the first one positive, shape (DOUBTS,).
    """

    spots: ChamberPlaces
    values: Singles
    slopes: Singles
    lines: Singles
    doubts: Singles

    def adjust_to_sister(self, rng: np.random.Generator, tolerance: float) -> ChamberCurves:
        """Return the balance of another machine of the series; see `ResidualSource.adjust_to_sister`."""
        paths, lines = len(self.values), len(self.lines)
        later, wider = (rng.uniform(-tolerance, tolerance, paths) for _ in range(2))
        values = opening_later(self.values.astype(np.float64), later) * (1.0 + wider[:, None])
        scaled = self.lines * (1.0 + rng.uniform(-tolerance, tolerance, lines))
        curves, slopes, factors = (one.astype(np.float32) for one in (values, slopes_of(values), scaled))
        return ChamberCurves(self.spots, curves, slopes, factors, self.doubts)


@dataclass(frozen=True)
class OilRange:
    """Temperatures of the oil at which balances are known to hold: leaks and dead times go with its viscosity.

    Attributes:
        column: index of the thermometer among the inputs.
        low: lowest temperature, in the unit of the channel.
        high: highest one.
    """

    column: int
    low: float
    high: float

    def beyond(self, values: Singles) -> NDArray[np.bool_]:
        """Return a mask of the temperatures outside the range."""
        outside: NDArray[np.bool_] = (values < np.float32(self.low)) | (values > np.float32(self.high))
        return outside


class FlowBalances(ResidualSource):
    """Fitted flow balances, one per chamber.

    A residual is the measured velocity minus the velocity computed from the flows, divided by the usual deviation in
    such a situation.

    Everything is that of `BACK` ticks ago, since the rate of a pressure needs ticks on either side. Where the oil is
    colder or hotter than it was learned, all are silent. A thermometer that fails silences nothing: its last value
    stands in.

    Args:
        inputs: raw channels, SI units.
        middle: mean of each on healthy sessions.
        spools: spool models by command.
        chambers: the balances.
        rate_hz: ticks per second.
        oil: temperatures at which they hold; None without a thermometer.
    """

    delay = BACK

    def __init__(
        self,
        inputs: Sequence[str],
        middle: Rows,
        spools: SpoolModel,
        chambers: Sequence[ChamberCurves],
        rate_hz: float,
        oil: OilRange | None = None,
    ) -> None:
        self.inputs, self.middle = tuple(inputs), np.asarray(middle, np.float32)
        self.spools, self.chambers, self.rate_hz = spools, tuple(chambers), rate_hz
        self.names = tuple(PREFIX + self.inputs[chamber.spots.own] for chamber in self.chambers)
        self.judged = tuple((self.inputs[chamber.spots.velocity],) for chamber in self.chambers)
        self.units = ("1",) * len(self.chambers)
        self.reads = tuple(self._read(chamber.spots) for chamber in self.chambers)
        self.per_tick = np.float32(rate_hz / 6.0)
        self.oil = oil

    def adjust_to_sister(self, rng: np.random.Generator, tolerance: float) -> FlowBalances:
        """See `ResidualSource.adjust_to_sister`."""
        spools = self.spools.adjust_to_sister(rng, tolerance, self.rate_hz)
        chambers = [chamber.adjust_to_sister(rng, tolerance) for chamber in self.chambers]
        return FlowBalances(self.inputs, self.middle, spools, chambers, self.rate_hz, self.oil)

    def unlearned(self, recording: Recording) -> str:
        """See `ResidualSource.unlearned`."""
        if self.oil is None or self.inputs[self.oil.column] not in recording.channel_names:
            return ""
        name = self.inputs[self.oil.column]
        share = float(self.oil.beyond(recording.column(name)).mean())
        if not share:
            return ""
        low, high = (KINDS[Kind.TEMPERATURE].to_report(limit) for limit in (self.oil.low, self.oil.high))
        return (
            f"balances of flow are silent in {percent(share)} of it: '{name}' is outside {figure(low)} to "
            f"{figure(high)} degC, which healthy logs cover"
        )

    def _read(self, spots: ChamberPlaces) -> tuple[str, ...]:
        places = [spots.velocity, spots.own, spots.other, spots.stroke, *spots.supplies]
        for spool in spots.spools:
            places += [int(self.spools.extend[spool]), int(self.spools.retract[spool])]
        return tuple(dict.fromkeys(self.inputs[i] for i in places if i >= 0))

    def _start(self, streams: int) -> Any:
        return None

    def _run(self, rows: Rows, there: NDArray[np.bool_], own: Any) -> tuple[Rows, Any]:
        memory = self.spools.memory
        if own is None:
            # At rest at the first row, as if it had been there for long.
            before = np.repeat(rows[:, :1], memory, axis=1)
            own = before, self.spools.start(self.spools.demands(rows[:, 0]))
        whole = np.concatenate([own[0], rows], axis=1)
        spools, state = self.spools.run(whole, own[1])
        end, ticks = whole.shape[1], rows.shape[1]
        then = whole[:, end - ticks - BACK : end - BACK]
        steps = [whole[:, end - ticks - back : end - back] for back in (0, 1, 3, 4)]
        rates = ((steps[0] - steps[3]) + (steps[1] - steps[2])) * self.per_tick
        out = [self._residual(chamber, then, rates, spools) for chamber in self.chambers]
        residuals = np.stack(out, axis=-1)
        if self.oil is not None:
            residuals[self.oil.beyond(rows[..., self.oil.column])] = np.nan
        return residuals, (whole[:, end - memory :].copy(), state)

    @staticmethod
    def _residual(chamber: ChamberCurves, rows: Singles, rates: Singles, spools: Singles) -> Singles:
        spots, flow = chamber.spots, np.zeros(rows.shape[:-1], np.float32)
        through, width = flow, flow
        paths = paths_of(spots, rows, spools)
        for (travel, drive), values, slopes in zip(paths, chamber.values, chamber.slopes, strict=True):
            part = opened(travel, values, slopes) * drive
            flow, through = flow + part, through + np.abs(part)
        for term, factor in zip(lines_of(spots, rows, rates), chamber.lines, strict=True):
            flow = flow + factor * term
        for term, factor in zip(doubts_of(spots, rows, rates, through), chamber.doubts, strict=True):
            width = width + factor * term
        off = rows[..., spots.velocity] - np.float32(spots.sign) * flow
        return np.asarray(off / width, np.float32)

    def parts(self) -> SourceParts:
        """See `ResidualSource.parts`."""
        places = [asdict(chamber.spots) for chamber in self.chambers]
        oil = None if self.oil is None else asdict(self.oil)
        plain = {"inputs": list(self.inputs), "rate_hz": self.rate_hz, "chambers": places, "oil": oil}
        arrays: dict[str, NDArray[Any]] = {"middle": self.middle}
        arrays |= {f"spools.{one.name}": getattr(self.spools, one.name) for one in fields(self.spools)}
        for index, chamber in enumerate(self.chambers):
            arrays |= {f"{index}.{name}": getattr(chamber, name) for name in NUMBERS}
        return SourceParts(plain, arrays)

    @classmethod
    def from_parts(cls, parts: SourceParts) -> FlowBalances:
        """See `ResidualSource.from_parts`."""
        inputs, middle = texts_of(parts.plain["inputs"], "its inputs"), source_arrays(parts, {})["middle"]
        rate_hz = float(parts.plain["rate_hz"])
        if not 0.0 < rate_hz <= 1e6:
            raise ValueError("its rate cannot be")
        sizes, own = {"inputs": len(inputs)}, arrays_under(parts.arrays, "spools.")
        spools = SpoolModel(**checked_arrays(own, SPOOLS, "its spools", sizes))
        entries = parts.plain["chambers"]
        if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_CHAMBERS:
            raise ValueError(f"it has no list of 1 to {MAX_CHAMBERS} chambers")
        chambers = [
            _chamber_of(_place_of(entry, len(inputs), len(spools.gain)), parts.arrays, index)
            for index, entry in enumerate(entries)
        ]
        return cls(inputs, middle, spools, chambers, rate_hz, _oil_of(parts.plain.get("oil"), len(inputs)))


def _oil_of(entry: Any, inputs: int) -> OilRange | None:
    if entry is None:
        return None
    oil = OilRange(int(entry["column"]), float(entry["low"]), float(entry["high"]))
    if not 0 <= oil.column < inputs:
        raise ValueError("its thermometer is an input that there is not")
    if not (np.isfinite(oil.low) and np.isfinite(oil.high) and oil.low <= oil.high):
        raise ValueError("temperatures of its oil are not finite, or the lowest is above the highest")
    return oil


def _place_of(entry: Any, inputs: int, spools: int) -> ChamberPlaces:
    single = {name: int(entry[name]) for name in ("velocity", "own", "other", "stroke", "sign")}
    lists = {name: tuple(int(value) for value in entry[name]) for name in ("supplies", "spools")}
    numbers = {name: float(entry[name]) for name in ("end", "far", "cushion", "tank")}
    columns = (single["velocity"], single["own"], single["other"], *lists["supplies"])
    if not all(0 <= column < inputs for column in columns) or not -1 <= single["stroke"] < inputs:
        raise ValueError("a chamber names an input that there is not")
    if not 1 <= len(lists["spools"]) <= 2 or not all(0 <= spool < spools for spool in lists["spools"]):
        raise ValueError("a chamber names a spool that there is not")
    if single["sign"] not in (-1, 1) or len(lists["supplies"]) > 8:
        raise ValueError("a chamber has a sign or a number of pumps that cannot be")
    if not all(np.isfinite(value) for value in numbers.values()) or numbers["cushion"] <= 0.0:
        raise ValueError("a number of a chamber is not finite, or its cushion has no length")
    values: Table = {**single, **lists, **numbers}
    return ChamberPlaces(**values)


def _chamber_of(spots: ChamberPlaces, arrays: Any, index: int) -> ChamberCurves:
    own = arrays_under(arrays, f"{index}.")
    numbers = checked_arrays(own, NUMBERS, f"chamber {index}", {"paths": spots.paths})
    if numbers["doubts"][0] <= 0.0:
        raise ValueError(f"the width of the balance of chamber {index} is {numbers['doubts'][0]}; above 0 must hold")
    return ChamberCurves(spots, **numbers)


@RESIDUALS.register("flow_balances")
@dataclass(frozen=True, kw_only=True)
class FlowBalancesSpec(ResidualSpec):
    """Balances of flow of every chamber of which command, velocity and both pressures are measured.

    Attributes:
        rows: ticks that curves are fitted to, at most.
        trials: numbers of trials for dead times, frequencies and play of the spools of an axis.
        min_explained: share of the mean size of the velocity that a balance must tell on sessions that did not train
            it; of less it evaluates nothing.

    Raises:
        ConfigError: a value is out of its bounds.
    """

    source: ClassVar[type[ResidualSource]] = FlowBalances
    rows: int = 200_000
    trials: int = 80
    min_explained: float = 0.6

    def __post_init__(self) -> None:
        check_bounds(
            "flow_balances", self, rows=integer(1000, MAX_ROWS), trials=integer(1, 10_000), min_explained=span(0.0, 1.0)
        )

    def fit(self, material: FitMaterial) -> ResidualSource | None:
        """See `ResidualSpec.fit`."""
        material.progress.note("balances of flow")
        balances = fit_chambers(material, self.rows, self.trials, self.min_explained)
        if balances is None:
            return None
        inputs, spools, fitted = balances
        chambers = [ChamberCurves(*one) for one in fitted]
        covered, oil = fit_oil_range(material), None
        if covered is not None:
            inputs = (*inputs, *(name for name in covered[:1] if name not in inputs))
            oil = OilRange(inputs.index(covered[0]), *covered[1:])
        return FlowBalances(inputs, mean_inputs(material, inputs), spools, chambers, material.rate_hz, oil)
