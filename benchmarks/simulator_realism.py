"""How simulated recordings compare with what the thesis found in its own: lags, delays, spreads, dependencies.

For the default data set of M22 in free air and for the example scenario of C14 in soil, every fact of the thesis's
signal analysis is measured and printed beside what the thesis states: lags of pilots, conflux, pressure and
acceleration against velocity (Table 4.2), which cylinder is slowest and which most transient, delays of a step, and
Pearson's correlation and mutual information at zero lag (section 4.1). The thesis found these on its simulation; C14 is
held to them as well. The error of persistence must lie above the thesis's models: of M22 above those on its simulation
(Table 4.3), of C14 above the fine-tuned one on its machine (Table 4.10), whose speeds follow from the same table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from sklearn.feature_selection import mutual_info_regression

from common import Bench, benchmark, option, table
from edp.recording import Recording
from edp.sim import Scenario, load_machine, simulate_many
from edp.sim.data_set import SimulationOrder
from edp.sim.machine import layout as at
from edp.sim.physics.plant import Plant

Array = NDArray[np.float64]
CYLINDERS = ("boom", "arm", "bucket")
PILOTS = (("BmUp", "BmDwn"), ("AmIn", "AmOut"), ("BktIn", "BktOut"))
MOST = 30
"""Longest lag searched, samples."""
NEIGHBOURS_FROM = 2000
"""Points of a recording for the nearest-neighbour estimate of mutual information."""
STILL = 1e-3
"""rms velocity (m/s) below which a cylinder stands still in a recording."""
FAST_HZ = 1.0
"""Pressures hardly follow the pose above this frequency."""
FINE_TUNED = (1.7, 3.1, 4.0)
"""MAE (mm/s) of the thesis's fine-tuned model on its machine 10 samples ahead, by cylinder (Table 4.10)."""
MACHINE_SPEEDS = (19.5, 56.5, 51.0)
"""Deviation (mm/s) of the velocities of the same test: root of MSE / (1 - R^2), both models agree within 2 %."""
SCENARIOS = Path(__file__).parents[1] / "examples" / "scenarios"


@dataclass(frozen=True)
class Fact:
    """One statement of the thesis with what was measured here.

    Attributes:
        name: what is compared.
        ours: by cylinder.
        thesis: the statement.
        met: how many cylinders (or the one comparison) agree, as a share.
    """

    name: str
    ours: tuple[float, ...]
    thesis: str
    met: float


def lag_of(lead: Sequence[Array], follow: Sequence[Array], signed: bool) -> int:
    """Return the lag in samples at which the correlation (its absolute value if not `signed`) is largest."""
    total = np.zeros(MOST + 1)
    for x, y in zip(lead, follow, strict=True):
        x, y = x - x.mean(), y - y.mean()
        total += [x[: len(x) - k] @ y[k:] / (len(x) - k) for k in range(MOST + 1)]
    return int(np.argmax(total if signed else np.abs(total)))


def fast(values: Sequence[Array], rate_hz: float) -> list[Array]:
    """Return the components above `FAST_HZ`, without delay."""
    filters = signal.butter(2, FAST_HZ, "highpass", fs=rate_hz, output="sos")
    return [signal.sosfiltfilt(filters, v) for v in values]


def bins_mi(x: Array, y: Array, bins: int = 32) -> float:
    """Mutual information in nat from quantile bins, less the bias of independent data of the same size."""

    def ranks(values: Array) -> NDArray[np.int64]:
        edges = np.unique(np.quantile(values, np.linspace(0, 1, bins + 1)[1:-1]))
        return np.searchsorted(edges, values, side="right")

    counts = np.zeros((bins, bins))
    np.add.at(counts, (ranks(x), ranks(y)), 1.0)
    share = counts / counts.sum()
    alone = np.outer(share.sum(axis=1), share.sum(axis=0))
    some = share > 0
    bias = ((counts.sum(1) > 0).sum() - 1) * ((counts.sum(0) > 0).sum() - 1) / (2 * len(x))
    return float(np.sum(share[some] * np.log(share[some] / alone[some])) - bias)


def neighbours_mi(signals: Signals, name: str, speed: str, seed: int) -> float:
    """Mutual information in nat by 3 nearest neighbours, each recording for itself, mean over recordings with motion.

    The thesis computed its scores per data set and compared them between sets.
    """
    found = []
    for x, y in zip(signals.each(name), signals.each(speed), strict=True):
        if y.std() > STILL:
            every = max(1, len(x) // NEIGHBOURS_FROM)
            found.append(mutual_info_regression(x[::every, None], y[::every], random_state=seed)[0])
    return float(np.mean(found))


@dataclass(frozen=True, eq=False)
class Signals:
    """Columns of a set of recordings."""

    recordings: Sequence[Recording]

    def each(self, name: str) -> list[Array]:
        """One channel of each recording."""
        return [r.column(name).astype(float) for r in self.recordings]

    def whole(self, name: str) -> Array:
        """One channel of all recordings in a row."""
        return np.concatenate(self.each(name))

    def pilot(self, i: int, suffix: str = "") -> list[Array]:
        """Signed demand of one cylinder: extension less retraction."""
        up, down = (self.each(name + suffix) for name in PILOTS[i])
        return [u - d for u, d in zip(up, down, strict=True)]


def lags(signals: Signals) -> dict[str, tuple[int, ...]]:
    """Lag of each group of features against the velocity of its cylinder, samples."""
    found: dict[str, list[int]] = {
        k: [] for k in ("pilot", "conflux", "head", "rod", "load", "fast load", "acceleration")
    }
    for i in range(3):
        speed = signals.each(f"CylVels_{i + 1}")
        head, rod = signals.each(f"CylPressures_{i + 1}"), signals.each(f"CylPressures_{i + 5}")
        found["pilot"].append(lag_of(signals.pilot(i), speed, True))
        found["conflux"].append(lag_of(signals.pilot(i, "Conf"), speed, True))
        found["head"].append(lag_of(head, speed, False))
        found["rod"].append(lag_of(rod, speed, False))
        load = [a - b for a, b in zip(head, rod, strict=True)]
        rate = signals.recordings[0].rate_hz
        found["load"].append(lag_of(load, speed, True))
        found["fast load"].append(lag_of(fast(load, rate), fast(speed, rate), True))
        found["acceleration"].append(lag_of(signals.each(f"CylAcc_{i + 1}"), speed, True))
    return {name: tuple(values) for name, values in found.items()}


def dependencies(signals: Signals, seed: int) -> dict[str, dict[str, tuple[float, ...]]]:
    """Pearson and both estimates of mutual information at zero lag, by feature, a value a cylinder."""
    found: dict[str, dict[str, list[float]]] = {}
    for i in range(3):
        up, down = PILOTS[i]
        names = {
            "acceleration": f"CylAcc_{i + 1}",
            "head pressure": f"CylPressures_{i + 1}",
            "rod pressure": f"CylPressures_{i + 5}",
            "pilot extend": up,
            "pilot retract": down,
            "conflux extend": up + "Conf",
            "conflux retract": down + "Conf",
        }
        speed = signals.whole(f"CylVels_{i + 1}")
        for feature, name in names.items():
            values = signals.whole(name)
            row = found.setdefault(feature, {"pearson": [], "bins": [], "neighbours": []})
            flat = values.std() < 1e-9
            row["pearson"].append(0.0 if flat else float(np.corrcoef(values, speed)[0, 1]))
            row["bins"].append(bins_mi(values, speed))
            row["neighbours"].append(neighbours_mi(signals, name, f"CylVels_{i + 1}", seed))
    return {f: {k: tuple(v) for k, v in row.items()} for f, row in found.items()}


def rises(name: str) -> dict[str, tuple[float, ...]]:
    """Return rise times (s) to 10 % and 63 % of the final speed for full, half and quarter steps at mid-stroke."""
    found: dict[str, list[float]] = {"10 %": [], "63 % least": [], "63 % most": []}
    for i in range(3):
        first, late = [], []
        for level in (0.4, 0.7, 1.0, -0.4, -0.7, -1.0):
            plant = Plant(load_machine(name), np.full(3, 0.5))
            plant.run(np.zeros((100, 3)))
            levers = np.zeros((80, 3))
            levers[:, i] = level
            speed = plant.run(levers)[:, at.LOG_VELOCITY + i]
            reached = np.abs(speed[50:70]).mean()
            first.append(int(np.argmax(np.abs(speed) > 0.10 * reached)) / 100)
            late.append(int(np.argmax(np.abs(speed) > 0.63 * reached)) / 100)
        found["10 %"].append(float(np.mean(first)))
        found["63 % least"].append(min(late))
        found["63 % most"].append(max(late))
    return {key: tuple(values) for key, values in found.items()}


def persistence(signals: Signals, k: int) -> tuple[float, ...]:
    """MAE (mm/s) of taking the present velocity for the one `k` samples ahead, by cylinder."""
    speeds = [signals.each(f"CylVels_{i + 1}") for i in range(3)]
    return tuple(1e3 * float(np.mean([np.abs(v[k:] - v[:-k]).mean() for v in each])) for each in speeds)


def of_the_simulation(signals: Signals) -> list[Fact]:
    """Errors of persistence against the thesis's models on its simulation."""
    near, far = (float(np.mean(persistence(signals, k))) for k in (1, 10))
    return [
        Fact("persistence MAE, k = 1, mm/s", (near,), "above 1.7-2.0 (models)", float(2.0 < near < 4.0)),
        Fact("persistence MAE, k = 10, mm/s", (far,), "above 16-18 (models)", float(18.0 < far < 32.0)),
    ]


def of_the_machine(signals: Signals) -> list[Fact]:
    """Errors of persistence and speeds against the thesis's test on its machine."""
    far = persistence(signals, 10)
    speed = tuple(1e3 * signals.whole(f"CylVels_{i + 1}").std() for i in range(3))
    return [
        Fact("persistence MAE, k = 1, mm/s", persistence(signals, 1), "", 1.0),
        Fact("persistence MAE, k = 10, mm/s", far, "above 1.7, 3.1, 4.0 (model)",
             float(np.mean(np.array(far) > FINE_TUNED))),
        Fact("velocity rms, mm/s, within a factor of 2", speed, "20, 57, 51",
             within(np.array(speed) / MACHINE_SPEEDS, 0.5, 2.0)),
    ]  # fmt: skip


def within(values: Sequence[float], low: float, high: float) -> float:
    """Share of the values in [low, high]."""
    return float(np.mean([low <= v <= high for v in values]))


def facts_of(signals: Signals, machine: str, seed: int) -> list[Fact]:
    """Every row of the comparison."""
    lag, rise, link = lags(signals), rises(machine), dependencies(signals, seed)
    speed = tuple(1e3 * signals.whole(f"CylVels_{i + 1}").std() for i in range(3))
    jerk = tuple(float(signals.whole(f"CylAcc_{i + 1}").std()) for i in range(3))
    facts = [
        Fact("pilot lag, samples", lag["pilot"], "12-18", within(lag["pilot"], 12, 18)),
        Fact("conflux lag, samples", lag["conflux"], "13-20", within(lag["conflux"], 13, 20)),
        Fact("head pressure lag, samples", lag["head"], "4-8", within(lag["head"], 4, 8)),
        Fact("rod pressure lag, samples", lag["rod"], "4-8", within(lag["rod"], 4, 8)),
        Fact("load pressure lag, samples", lag["load"], "4-8", within(lag["load"], 4, 8)),
        Fact("load pressure lag above 1 Hz, samples", lag["fast load"], "", 1.0),
        Fact("acceleration lag, samples", lag["acceleration"], "5-12", within(lag["acceleration"], 5, 12)),
        Fact("velocity rms, mm/s", speed, "boom slowest", float(np.argmin(speed) == 0)),
        Fact("acceleration rms, m/s^2", jerk, "bucket most transient", float(np.argmax(jerk) == 2)),
        Fact("rise to 10 %, ms", tuple(1e3 * v for v in rise["10 %"]), "boom latest, above 100",
             float(np.argmax(rise["10 %"]) == 0 and rise["10 %"][0] > 0.1)),
        Fact("rise to 63 %, least, ms", tuple(1e3 * v for v in rise["63 % least"]), "varies with context",
             float(np.mean(np.array(rise["63 % most"]) > 1.1 * np.array(rise["63 % least"])))),
        Fact("rise to 63 %, most, ms", tuple(1e3 * v for v in rise["63 % most"]), "varies with context",
             float(np.mean(np.array(rise["63 % most"]) > 1.1 * np.array(rise["63 % least"])))),
    ]  # fmt: skip
    pearson = link["acceleration"]["pearson"]
    facts.append(Fact("acceleration, Pearson", pearson, "negligible", within(np.abs(pearson), 0, 0.1)))
    for estimate, title in (("bins", "32 bins"), ("neighbours", "per recording")):
        found = {feature: row[estimate] for feature, row in link.items()}
        pilots = np.max([v for f, v in found.items() if f.startswith(("pilot", "conflux"))], axis=0)
        pressures = np.max([found["head pressure"], found["rod pressure"]], axis=0)
        size = found["acceleration"]
        facts.append(Fact(f"acceleration, MI ({title})", size, "notable", within(size, 0.05, np.inf)))
        facts += [Fact(f"{f}, MI ({title})", v, "", 1.0) for f, v in found.items() if f != "acceleration"]
        above = tuple(float(p - q) for p, q in zip(pressures, pilots, strict=True))
        facts.append(Fact(f"pressure less pilot, MI ({title})", above, "above 0", within(above, 0, np.inf)))
    return facts + (of_the_simulation(signals) if machine == "M22" else of_the_machine(signals))


def scenarios(machine: str, minutes: float, seed: int) -> tuple[Scenario, ...]:
    """M22: the default data set, in free air. C14: its example, in free air and in soil."""
    example = None if machine == "M22" else SCENARIOS / "c14_soil.toml"
    return SimulationOrder.from_scenario(
        example, minutes=minutes, recordings=max(7, round(minutes)), seed=seed
    ).scenarios()


def show(title: str, facts: Sequence[Fact]) -> None:
    """Print ours beside the thesis."""
    print(f"\n{title}")
    rows: list[list[Any]] = []
    for fact in facts:
        cells = [f"{v:.3g}" for v in fact.ours] if len(fact.ours) == 3 else [f"{fact.ours[0]:.3g}", "", ""]
        said = "" if not fact.thesis else "met" if fact.met == 1 else "not met" if fact.met == 0 else "in part"
        rows.append([fact.name, *cells, fact.thesis, said])
    table(["fact", *CYLINDERS, "thesis", "verdict"], rows)


@benchmark(option("--workers", type=int, default=2))
def main(bench: Bench) -> object:
    kept = {}
    for machine, title in (("M22", "M22, default mix, free air"), ("C14", "C14, free air and soil")):
        plan = scenarios(machine, 4.0 if bench.quick else 40.0, bench.seed)
        signals = Signals(list(simulate_many(plan, bench.options.workers)))
        facts = facts_of(signals, machine, bench.seed)
        minutes = sum(r.duration_s for r in signals.recordings) / 60
        show(f"{title}, {minutes:.0f} min", facts)
        stated = [f for f in facts if f.thesis]
        met = float(sum(f.met for f in stated))
        bench.check(f"facts of the thesis met, {machine}", met, len(stated), ">= 0.8", "facts")
        kept[machine] = [vars(f) for f in facts]
    return kept


if __name__ == "__main__":
    main()
