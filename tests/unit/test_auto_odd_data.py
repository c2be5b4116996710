"""The preset auto on little and on odd data: it trains, promises a number, keeps up with simple rivals, is reported.

Synthetic logs of a valve with a dead band that drives a cylinder; where a public set has the trait, that set, too.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import build
from edp.logs.repair import Repair
from edp.report import build_report
from edp.storage import read_json
from edp.workflows.auto import candidates, load_auto, train_auto
from edp.workflows.train_evaluate import DataSource, evaluate

pytestmark = pytest.mark.processes

ROOT = Path(__file__).parents[2]
REAL = ROOT / "examples" / "real"
SHARED = Path(os.environ.get("EDP_SHARED_DATA") or ROOT.parent / "shared" / "data")
RIVALS = ("persistence", "ridge_arx")
QUICK = (
    *("auto.time_budget_min=0.001", "auto.candidates=['linear', 'committee']"),
    *("evaluation.baselines=['persistence', 'ridge_arx']", "evaluation.history=20"),
)
UNITS = {"velocity": "m/s", "pressure": "Pa", "generic": "1"}
KINDS = {"v": "velocity", "p": "pressure"}
BY_TIME = "split.kind='time'"
Columns = dict[str, np.ndarray]


def rig(seed: int, seconds: float, rate: float, hold_s: float = 0.5, idle: float = 0.0) -> Columns:
    """Lever u, cylinder speed v with sensor noise, position x, pressure p with sensor noise.

    Args:
        seed: of lever and noise.
        seconds: duration.
        rate: samples per second.
        hold_s: the lever holds a value between half as long and twice as long.
        idle: share of the pieces of 10 s in which the lever rests.
    """
    rng, ticks = np.random.default_rng(seed), int(seconds * rate)
    hold = max(1, int(hold_s * rate))
    holds = rng.integers(max(1, hold // 2), 2 * hold + 1, size=2 * ticks // hold + 2)
    lever = np.repeat(rng.uniform(-1, 1, len(holds)), holds)[:ticks]
    size = int(10 * rate)
    rests = rng.permutation(-(-ticks // size)) < round(idle * -(-ticks // size))
    lever[np.repeat(rests, size)[:ticks]] = 0.0
    opening = np.sign(lever) * np.maximum(0.0, np.abs(lever) - 0.15)
    speed, pressure = np.zeros(ticks), np.zeros(ticks)
    keep = math.exp(-1 / (0.15 * rate))
    for tick in range(1, ticks):
        speed[tick] = keep * speed[tick - 1] + (1 - keep) * 0.5 * math.tanh(2 * opening[tick - 1])
        pressure[tick] = 0.8 * pressure[tick - 1] + 0.2 * (20 * speed[tick] ** 2 + 5 * opening[tick - 1])
    return {
        "u": lever,
        "v": speed + 0.005 * rng.normal(size=ticks),
        "x": np.cumsum(speed) / rate,
        "p": 1e5 * (pressure + 0.05 * rng.normal(size=ticks)),
    }


@dataclass(frozen=True)
class Oddity:
    """Logs with a trait.

    Attributes:
        logs: makes the columns of each log.
        rate: samples per second.
        settings: the task.
        factor: the test error may be so many times that of the better of the rivals.
        lost: ticks that the logger lost, as pairs of first and last.
        missing: ticks at which the channel p has no value, likewise.
    """

    logs: Callable[[], Sequence[Columns]]
    rate: float
    settings: Sequence[str]
    factor: float = 1.1
    kinds: Mapping[str, str] = field(default_factory=lambda: KINDS)
    lost: Sequence[tuple[int, int]] = ()
    missing: Sequence[tuple[int, int]] = ()


def encoder() -> Columns:
    """A position in steps of 2 mm: the speed is a hundred times the step, most differences are zero."""
    columns = rig(3, 60, 50)
    return columns | {"x": 0.002 * np.round(columns["x"] / 0.002)}


def rests_at_its_end() -> Columns:
    """Two minutes of which six tenths are rest, the last fifth altogether; everything is measured in steps."""
    columns = rig(34, 120, 50, idle=0.6)
    steps = {"v": 0.02, "x": 0.002, "p": 2e4}
    return columns | {name: step * np.round(columns[name] / step) for name, step in steps.items()}


def of_sizes() -> Columns:
    """Two outputs, one in millionths, the other in millions."""
    columns = rig(4, 60, 50)
    return {"u": columns["u"], "small": 1e-6 * columns["v"], "large": 10 * columns["p"]}


def moves_late() -> Columns:
    """A channel that says nothing, and stands still until the test part."""
    columns = rig(13, 60, 50)
    late = np.where(np.arange(3000) < 2600, 3.7, 3.7 + np.random.default_rng(13).normal(size=3000))
    return columns | {"k": late}


def two_rates() -> Columns:
    """A pressure that its own clock samples 7.3 times a second, the other channels 50 times."""
    columns = rig(14, 60, 50)
    read = (np.floor(np.arange(3000) * 7.3 / 50) * 50 / 7.3).astype(int)
    return columns | {"p": columns["p"][read]}


def wide() -> Columns:
    """Sixty channels of which most drift about."""
    columns = rig(15, 40, 50)
    drift = 0.05 * np.cumsum(np.random.default_rng(15).normal(size=(2000, 56)), axis=0)
    return columns | {f"c{number}": drift[:, number] for number in range(56)}


def many_outputs() -> Columns:
    """Eight speeds, each of which follows the lever later than the one before."""
    columns = rig(16, 60, 50)
    noise = 0.005 * np.random.default_rng(16).normal(size=(3000, 7))
    later = {f"v{number + 1}": np.roll(columns["v"], 2 * number + 2) + noise[:, number] for number in range(7)}
    return {name: columns[name] for name in ("u", "v", "p")} | later


def collinear() -> Columns:
    """A copy of the target, a copy of the lever, and sums of channels."""
    columns = rig(31, 60, 50)
    u, v, p = columns["u"], columns["v"], columns["p"]
    return columns | {"v2": v, "u2": u, "sum": u + 0.5 * v, "turned": -2 * p}


def spiked() -> Columns:
    """Twenty ticks each at which speed and pressure are off by fifty spreads."""
    columns, draw = rig(32, 60, 50), np.random.default_rng(32)
    for name in ("v", "p"):
        spikes = draw.integers(0, len(columns[name]), 20)
        columns[name][spikes] += 50 * columns[name].std() * draw.choice([-1.0, 1.0], 20)
    return columns


def delayed() -> Columns:
    """A second measurement of the speed that comes three ticks late."""
    columns = rig(33, 60, 50)
    return columns | {"late": np.roll(columns["v"], 3)}


ODDITIES = {
    "columns that say the same": Oddity(lambda: [collinear()], 50, ["task.targets=['v']", "task.horizons=[1, 5]"]),
    "outliers": Oddity(lambda: [spiked()], 50, ["task.targets=['v']", "task.horizons=[5]"]),
    "a delayed copy of the target": Oddity(lambda: [delayed()], 50, ["task.targets=['v']", "task.horizons=[5]"]),
    "two recordings of very different lengths": Oddity(
        lambda: [rig(36, 100, 50), rig(37, 4, 50)], 50, ["task.targets=['v']", "task.horizons=[1, 5]"]
    ),
    "a recording far shorter than the others": Oddity(
        lambda: [rig(36, 60, 50), rig(38, 60, 50), rig(37, 2, 50)], 50, ["task.targets=['v']", "task.horizons=[5]"]
    ),
    "a channel that first moves in the test part": Oddity(
        lambda: [moves_late()], 50, ["task.targets=['v']", "task.horizons=[5]"]
    ),
    "channels of two rates": Oddity(lambda: [two_rates()], 50, ["task.targets=['v', 'p']", "task.horizons=[5]"]),
    "missing values": Oddity(
        lambda: [rig(17, 60, 50)],
        50,
        ["task.targets=['v']", "task.horizons=[5]", BY_TIME],
        missing=((300, 340), (1000, 1200), (2700, 2705)),
    ),
    "sixty channels": Oddity(lambda: [wide()], 50, ["task.targets=['v']", "task.horizons=[5]"]),
    "twenty-four outputs": Oddity(
        lambda: [many_outputs()],
        50,
        [
            *("task.targets=['v', 'v1', 'v2', 'v3', 'v4', 'v5', 'v6', 'v7']", "task.horizons=[1, 4, 10]"),
            "task.features={name='speeds', channels=['u', 'v', 'p', 'v1', 'v2', 'v3', 'v4', 'v5', 'v6', 'v7']}",
        ],
    ),
    "half a minute": Oddity(lambda: [rig(1, 30, 100)], 100, ["task.targets=['v']", "task.horizons=[10]"], 1.15),
    "5 Hz": Oddity(
        lambda: [rig(seed, 200, 5, hold_s=2) for seed in range(4)], 5, ["task.targets=['v']", "task.horizons=[2]"]
    ),
    "a quantised encoder": Oddity(
        lambda: [encoder()], 50, ["task.targets=['x']", "task.horizons=[5]", BY_TIME], kinds={"v": "velocity"}
    ),
    "idling nine tenths of the time": Oddity(
        lambda: [rig(seed, 100, 50, idle=0.9) for seed in range(4)], 50, ["task.targets=['v']", "task.horizons=[5]"]
    ),
    "one recording, two horizons": Oddity(
        lambda: [rig(6, 60, 50)], 50, ["task.targets=['v', 'p']", "task.horizons=[1, 5]"]
    ),
    "values in place of changes": Oddity(
        lambda: [rig(7, 60, 50)], 50, ["task.targets=['v']", "task.horizons=[5]", "task.mode='absolute'"]
    ),
    "a target that no input measures": Oddity(
        lambda: [rig(8, 60, 50)],
        50,
        [
            *("task.targets=['v']", "task.horizons=[0]", "task.mode='absolute'"),
            "task.features={name='blind', channels=['u', 'p']}",
        ],
    ),
    "a speed derived from a position": Oddity(
        lambda: [rig(9, 60, 50)],
        50,
        [
            *("task.targets=['dx']", "task.horizons=[5]", "task.mode='absolute'"),
            "task.features={name='position', channels=['u', 'x']}",
            "task.derived_targets=[{name='dx', source='x', how='derivative'}]",
        ],
    ),
    "pressure": Oddity(lambda: [rig(10, 60, 100)], 100, ["task.targets=['p']", "task.horizons=[5]"]),
    "many short recordings": Oddity(
        lambda: [rig(100 + seed, 3, 50) for seed in range(30)], 50, ["task.targets=['v']", "task.horizons=[5]"]
    ),
    "gaps": Oddity(
        lambda: [rig(11, 80, 50)],
        50,
        ["task.targets=['v']", "task.horizons=[5]", BY_TIME],
        lost=((500, 600), (1500, 1520), (2000, 2400), (3000, 3003)),
    ),
    "a constant column": Oddity(
        lambda: [rig(12, 60, 50) | {"k": np.full(3000, 3.7)}], 50, ["task.targets=['v']", "task.horizons=[5]"]
    ),
    "rest and steps at the end": Oddity(
        lambda: [rests_at_its_end()], 50, ["task.targets=['v', 'p']", "task.horizons=[10]"], 1.02
    ),
    "sizes 1e-6 and 1e6": Oddity(
        lambda: [of_sizes()], 50, ["task.targets=['small', 'large']", "task.horizons=[5]"], kinds={}
    ),
}


def write(folder: Path, oddity: Oddity) -> DataSource:
    """The logs as CSV with a map; ticks that were lost are no rows."""
    logs = oddity.logs()
    (folder / "logs").mkdir(parents=True)
    for number, columns in enumerate(logs):
        table = np.column_stack([np.arange(len(columns["u"])) / oddity.rate, *columns.values()])
        for first, last in oddity.lost:
            table[first:last] = np.nan
        for first, last in oddity.missing:
            table[first:last, 1 + list(columns).index("p")] = np.nan
        rows = table[np.isfinite(table[:, 0])]
        head = ",".join(("time", *columns))
        np.savetxt(folder / "logs" / f"{number:02d}.csv", rows, "%.9g", ",", header=head, comments="")
    entries = ['time = "time"']
    for name in logs[0]:
        kind = oddity.kinds.get(name, "generic")
        entries.append(f'[channels.{name}]\ncolumn = "{name}"\nkind = "{kind}"\nunit = "{UNITS[kind]}"')
    (folder / "map.toml").write_text("\n".join(entries) + "\n")
    mended = {"gaps": "cut"} if oddity.lost else {"nan": "hold"} if oddity.missing else None
    repair = None if mended is None else build(Repair, mended, "test")
    return DataSource.from_path(folder / "logs", folder / "map.toml", repair)


def check(source: DataSource, settings: Sequence[str], factor: float, folder: Path, path: Path | None = None) -> None:
    """Train, judge beside simple rivals, and draw the page."""
    facts = train_auto(source, load_auto(path, [*settings, *QUICK]), folder).choice.to_table()
    for candidate in facts["candidates"].values():
        promised = [error for row in candidate["promise"].values() for error in row.values()]
        assert np.isfinite(promised).all()
        assert min(promised) > 0
    evaluate(folder)
    scores = read_json(folder / "scores.json")
    models = {name: model["overall"] for name, model in scores["models"].items()}
    excess = []
    for horizon in map(str, scores["task"]["horizons"]):
        for target in (entry["name"] for entry in scores["targets"]):
            errors = {name: overall[horizon][target]["rmse"] for name, overall in models.items()}
            excess.append(math.log(errors["network"] / min(errors[name] for name in RIVALS)))
    assert math.exp(np.mean(excess)) <= factor, np.exp(excess)
    page = build_report(folder).read_text(encoding="utf-8")
    assert "Why this model" in page


def test_a_machine_that_rests_and_is_measured_in_steps_is_left_at_rest(tmp_path):
    """Persistence is exactly right of most ticks: the absolute error must not be above its own."""
    columns = rig(34, 100, 50, idle=0.6)
    columns = columns | {"v": 0.02 * np.round(columns["v"] / 0.02)}
    source = write(tmp_path, Oddity(lambda: [columns], 50, []))
    settings = ["task.targets=['v']", "task.horizons=[1]", *QUICK[:1], *QUICK[2:], "auto.candidates=['linear']"]
    train_auto(source, load_auto(None, settings), tmp_path / "run")
    evaluate(tmp_path / "run")
    models = read_json(tmp_path / "run" / "scores.json")["models"]
    errors = {name: models[name]["overall"]["1"]["v"] for name in ("network", *RIVALS)}
    assert errors["network"]["mae"] < 0.9 * errors["ridge_arx"]["mae"]
    assert errors["network"]["mae"] < 1.05 * errors["persistence"]["mae"]
    assert errors["network"]["rmse"] < 1.05 * errors["ridge_arx"]["rmse"]


SMALLER = {"UNITS": 16, "MIN_STEPS": 100, "CENTRES": 100}
"""Sizes of a committee that trains in a fraction of the time; `make test-slow` takes the preset's own."""


@pytest.mark.parametrize(
    "sizes", [pytest.param(SMALLER, id="smaller"), pytest.param({}, id="", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", ODDITIES)
def test_it_keeps_up_with_simple_rivals_on(name, sizes, tmp_path, monkeypatch):
    for constant, size in sizes.items():
        monkeypatch.setattr(candidates, constant, size)
    oddity = ODDITIES[name]
    check(write(tmp_path, oddity), oddity.settings, oddity.factor, tmp_path / "run")


@pytest.mark.shared_data
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "settings", "factor"),
    [
        pytest.param("sjoberg", (), 1.1, id="a thousand samples, pressure and speed"),
        pytest.param("tanks", (), 1.1, id="a sample in four seconds"),
        pytest.param("emps", (), 1.5, id="an encoder, and pulses that never trained"),
        pytest.param("hanging_load", (), 1.1, id="one recording"),
        pytest.param("hanging_load", ("task.mode='absolute'",), 1.1, id="values in place of changes"),
    ],
)
def test_it_keeps_up_on_measured_recordings(name, settings, factor, tmp_path, monkeypatch):
    if not SHARED.is_dir():
        pytest.skip("no folder of measured recordings; EDP_SHARED_DATA names it")
    monkeypatch.setenv("EDP_SHARED_DATA", str(SHARED))
    check(
        DataSource.from_path(REAL / f"{name}.toml"), settings, factor, tmp_path / "run", REAL / f"{name}_settings.toml"
    )
