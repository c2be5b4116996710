"""Where is the error of the best networks, and what would remove it?

Machine M22, default mix, in free air or, with ``--soil``, in it and three soils. Networks of one preset with
equal updates read what is measured, then besides it one group of what only the simulator knows (an oracle): pump
displacements, spool positions, noise-free pressures, oil temperature, strokes where these are not measured. Their
errors, and those of the forecasts of a grey box where ``--forecasts`` names the folder of ``twin_forecast.py --work``,
are divided by situations that the simulator's own channels tell: relief, power limit, regeneration, conflux, spools
that cross their dead band, end stops, reversals. A ridge regression on the inputs' history says how much of each group
it holds already.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from common import finish, in_folder, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.prepared import Prepared, prepare
from edp.logs.source import DataSource
from edp.networks.predictor import Predictor
from edp.networks.running import streamed
from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.sim import load_machine
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.training.fit import fit

Array = NDArray[np.float64]
HORIZON = 10
AXES = 3
TARGETS = ("CylVels_1", "CylVels_2", "CylVels_3")
MEASURED = (*TABLE_A1, "PumpPressure_1", "PumpPressure_2")
STROKES = ("CylStroke_1", "CylStroke_2", "CylStroke_3")
ORACLES: Mapping[str, tuple[str, ...]] = {
    "nothing more": (),
    "strokes": STROKES,
    "pump displacement": ("PumpDisplacement_1", "PumpDisplacement_2"),
    "spool positions": tuple(f"SpoolPos_{n}" for n in range(1, 7)),
    "true pressures": tuple(f"True{name}" for name in TABLE_A1 if name.startswith("CylPressures")),
    "oil temperature": ("OilTemperature",),
}
GROUND = {"contact, force and load of the ground": ("Event_SoilContact", "TipForceX", "TipForceY", "Payload")}
"""What a soil-aware state could know at best, with --soil; the truth, which no sensor shows."""
ALL = "all of these"
"""Every channel of the oracles at once: one long training that says whether any of them is worth something."""
CONFLUX = (("BmUpConf", "BmDwnConf"), ("AmInConf", "AmOutConf"), ("BktInConf", "BktOutConf"))
EVENTS = {
    "relief open": "Event_Relief",
    "below tank pressure": "Event_Cavitation",
    "regeneration": "Event_Regeneration",
    "power limit": "Event_PowerLimit",
    "soil contact": "Event_SoilContact",
}
SOILS = ("air", "sandy_loam", "clay", "gravel")
LAGS = (0, 1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)
"""Ticks back that the ridge regression reads."""


def main() -> None:
    made = parser(__doc__ or "")
    made.add_argument("--minutes", type=float, default=60.0, help="of all recordings")
    made.add_argument("--each", type=float, default=3.0, help="minutes of one recording")
    made.add_argument("--soil", action="store_true", help="let grading and digs work soils, too")
    made.add_argument("--updates", type=int, default=1200)
    made.add_argument("--preset", choices=("quick", "standard"), default="quick", help="of the networks")
    made.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="changes of the preset")
    made.add_argument(
        "--oracles", nargs="*", choices=(*ORACLES, *GROUND, ALL), default=list(ORACLES), help="first the plain one"
    )
    made.add_argument("--forecasts", type=Path, default=None, help="folder that twin_forecast.py --work left")
    made.add_argument("--work", type=Path, default=None, help="folder that keeps the data")
    arguments = made.parse_args()
    if arguments.quick:
        arguments.minutes, arguments.updates = 3.5, 20
    if len(arguments.oracles) < 2 or arguments.oracles[0] != "nothing more":
        made.error("--oracles: 'nothing more' first, and at least one beside it, to be compared with it")
    in_folder(arguments.work, lambda work: run(arguments, work))


def run(arguments: Any, work: Path) -> None:
    """Networks, situations, tables."""
    recordings = data_of(arguments, work)
    rows, knowledge, errors = {}, {}, {}
    hidden = {**ORACLES, **GROUND, ALL: tuple(channel for channels in ORACLES.values() for channel in channels)}
    for name in arguments.oracles:
        channels = hidden[name]
        data, errors[name] = trained(recordings, channels, arguments)
        if channels:
            knowledge[name] = known_by_history(recordings, data, channels)
        print(f"{name}: {1e3 * np.mean([e.mean() for e in errors[name].values()]):.3f} mm/s", flush=True)
    if arguments.forecasts is not None:
        errors["forecasts of a grey box"] = forecast_errors(arguments.forecasts, errors["nothing more"])
    tested = [r for r in recordings if r.name in errors["nothing more"]]
    situations = {r.name: situations_of(r) for r in tested}
    for name, by_recording in errors.items():
        rows[name] = divided(by_recording, situations)
    show(rows, knowledge)
    plain, best = rows["nothing more"]["all"]["mae"], min(rows[name]["all"]["mae"] for name in arguments.oracles)
    asked = [
        verdict("error at k = 10 with the best oracle against none", best, plain, "<= 0.9", "mm/s", arguments.quick)
    ]
    finish("error_by_situation", asked, arguments.seed, {"rows": rows, "explained by the inputs' history": knowledge})


def data_of(arguments: Any, work: Path) -> list[Recording]:
    """Recordings with true pressures beside the measured ones; those of the forecasts' folder where it is named."""
    logs = work / "logs" if arguments.forecasts is None else arguments.forecasts / "logs"
    count = 7 if arguments.quick else round(arguments.minutes / arguments.each)
    materials = dict.fromkeys(SOILS, 1.0) if arguments.soil else {}
    order = SimulationOrder(minutes=arguments.minutes, recordings=count, seed=arguments.seed + 1, materials=materials)
    simulate_data_set(logs, order)
    silent = work / "silent.toml"
    silent.write_text(_machine_text().replace("pressure = 1.5e4 ", "pressure = 0.0 "), encoding="utf-8")
    if load_machine(str(silent)).sensors.pressure != 0.0:
        raise SystemExit("the machine file has another line of pressure noise; correct this script")
    simulate_data_set(work / "silent", dataclasses.replace(order, machine=str(silent)))
    return [_joined(*pair) for pair in zip(_read(logs), _read(work / "silent"), strict=True)]


def _machine_text() -> str:
    from importlib import resources

    return resources.files("edp.sim").joinpath("machines", "m22.toml").read_text(encoding="utf-8")


def _read(folder: Path) -> list[Recording]:
    return sorted(DataSource.of(folder).read(), key=lambda recording: recording.name)


def _joined(noisy: Recording, silent: Recording) -> Recording:
    """The recording with the pressures of the silent one as further channels; both must be of the same motion."""
    if not np.array_equal(noisy.column("TipX"), silent.column("TipX")):
        raise SystemExit(f"'{noisy.name}' moves otherwise without noise of pressures")
    names = [name for name in noisy.channel_names if name.startswith("CylPressures")]
    added = tuple(
        dataclasses.replace(noisy.channels[noisy.index(name)], name=f"True{name}") for name in names
    )  # fmt: skip
    values = np.concatenate([noisy.values, silent.select(names)], axis=1, dtype=np.float32)
    return dataclasses.replace(noisy, channels=noisy.channels + added, values=values)


def trained(
    recordings: Sequence[Recording], oracle: Sequence[str], arguments: Any
) -> tuple[Prepared, dict[str, Array]]:
    """Train on all measured channels and an oracle's; absolute errors ``(tick, axis)`` of each held-out recording."""
    features = f"task.features={{name='f', channels={[*MEASURED, *oracle]}}}"
    settings = load_experiment(
        None,
        arguments.preset,
        (features, f"task.horizons=[{HORIZON}]", f"training.seed={arguments.seed}", *arguments.set),
    )
    first = recordings[0]
    task = settings.task.resolve(first.rate_hz, first.channel_names, None)
    data = prepare(recordings, task, settings.split, settings.model.window)
    epochs = 2 if arguments.quick else 6
    training = dataclasses.replace(settings.training, epochs=epochs, updates=max(1, arguments.updates // epochs))
    predictor: Predictor = fit(data, settings.model, training).predictor
    window = settings.model.window
    return data, {
        data.test[number].name: _size(values[:, 0], data.test[number].targets, window)
        for number, values in streamed(predictor, predictor.predict, data.test)
    }


def _size(predicted: NDArray[Any], truth: NDArray[Any], skip: int) -> Array:
    """Absolute errors of predictions for `HORIZON` ticks later, m/s; NaN in the first `skip` ticks."""
    ticks = len(truth) - HORIZON
    size = np.abs(predicted[:ticks].astype(np.float64) - truth[HORIZON:])
    size[:skip] = np.nan
    return size[skip:]


def forecast_errors(folder: Path, beside: Mapping[str, Array]) -> dict[str, Array]:
    """Errors of the forecasts as they stand in the logs, of the same recordings and ticks."""
    errors = {}
    for recording in _read(folder / "ahead"):
        if recording.name in beside:
            truth = recording.select(TARGETS)
            ahead = recording.select([f"{name}_in_{HORIZON}" for name in TARGETS])
            errors[recording.name] = _size(ahead, truth, len(truth) - HORIZON - len(beside[recording.name]))
    if errors.keys() != beside.keys():
        raise SystemExit(f"'{folder}' has other held-out recordings: {sorted(errors)}, {sorted(beside)}")
    return errors


def situations_of(recording: Recording) -> dict[str, NDArray[np.bool_]]:
    """By name where it holds at tick t, ``(tick, axis)``, for ticks with a truth; told by the simulator."""
    ticks = recording.samples - HORIZON
    machine = load_machine("M22")
    speed, spool = recording.select(TARGETS), recording.select([f"SpoolPos_{n}" for n in range(1, 4)])
    stroke, length = recording.select(STROKES), np.array(machine.cylinders.stroke)
    valves = machine.valves
    open_now = (spool > valves.dead_band_extend) | (spool < -np.array(valves.dead_band_retract))
    cushion = np.array(machine.cylinders.cushion_length)
    conflux = np.stack([sum(recording.column(name) for name in pair) for pair in CONFLUX], axis=1)
    now, then = slice(0, ticks), slice(HORIZON, HORIZON + ticks)
    both_open = open_now[now] & open_now[then]
    masks = {
        "reversal of the velocity": (speed[now] * speed[then] < 0) & (np.abs(speed[now]) > 2e-3),
        "spool opens within k": ~open_now[now] & open_now[then],
        "spool closes within k": open_now[now] & ~open_now[then],
        "spool turns over within k": both_open & (spool[now] * spool[then] < 0),
        "spool stays in its dead band": ~open_now[now] & ~open_now[then],
        "in a cushion or at a stop": ((stroke < cushion) | (stroke > length - cushion))[now],
        "conflux": conflux[now] > 1e4,
    }
    for name, channel in EVENTS.items():
        masks[name] = np.repeat(recording.column(channel)[now, None] > 0.5, AXES, axis=1)
    masks["none of these"] = ~np.logical_or.reduce(list(masks.values()))
    masks["all"] = np.ones((ticks, AXES), dtype=bool)
    return masks


def divided(
    errors: Mapping[str, Array], situations: Mapping[str, Mapping[str, NDArray[np.bool_]]]
) -> dict[str, dict[str, float]]:
    """By situation its share of the time and of the error, and the error there (mm/s), axes pooled."""
    names = next(iter(situations.values()))
    total, count, rows = sum(e.sum() for e in errors.values()), sum(e.size for e in errors.values()), {}
    for name in names:
        masks = {key: situations[key][name][-len(size) :] for key, size in errors.items()}
        inside = sum(mask.sum() for mask in masks.values())
        error = sum(size[masks[key]].sum() for key, size in errors.items())
        mae = float(1e3 * error / inside) if inside else 0.0
        rows[name] = {"share": float(inside / count), "of_error": float(error / total), "mae": mae}
    return rows


def known_by_history(recordings: Sequence[Recording], data: Prepared, channels: Sequence[str]) -> float:
    """Share of the variance of channels that a ridge regression on the measured history explains, held out."""
    trained_names, tested_names = ({series.name for series in part} for part in (data.train, data.test))

    def tables(names: set[str]) -> tuple[Array, Array]:
        pairs = [_lagged(r, channels) for r in recordings if r.name in names]
        return np.concatenate([x for x, _ in pairs]), np.concatenate([y for _, y in pairs])

    x, y = tables(trained_names)
    centre, spread = x.mean(axis=0), x.std(axis=0) + 1e-12
    x = (x - centre) / spread
    mean = y.mean(axis=0)
    weights = np.linalg.solve(x.T @ x + 1e-3 * len(x) * np.eye(x.shape[1]), x.T @ (y - mean))
    x, y = tables(tested_names)
    left = y - mean - ((x - centre) / spread) @ weights
    # Of a channel that stands still in the held-out logs nothing is to be explained.
    moves = y.std(axis=0) > 1e-9
    return float(np.mean(1.0 - left[:, moves].var(axis=0) / y[:, moves].var(axis=0))) if moves.any() else 1.0


def _lagged(recording: Recording, channels: Sequence[str]) -> tuple[Array, Array]:
    """Every fifth tick: the measured channels at `LAGS`, and what is to be explained."""
    values, ticks = recording.select(MEASURED).astype(np.float64), np.arange(max(LAGS), recording.samples, 5)
    rows = np.concatenate([values[ticks - lag] for lag in LAGS], axis=1)
    return rows, recording.select(channels).astype(np.float64)[ticks]


def show(rows: Mapping[str, Any], knowledge: Mapping[str, float]) -> None:
    """Errors by situation, a column a model; then what the history holds."""
    plain = rows["nothing more"]
    lines = [
        [name, f"{row['share']:.1%}", f"{row['of_error']:.1%}", *(rows[model][name]["mae"] for model in rows)]
        for name, row in sorted(plain.items(), key=lambda item: -item[1]["of_error"])
        if row["share"]
    ]
    table(["k = 10, mm/s", "of the time", "of the error", *rows], lines)
    print()
    table(["explained by the inputs' history", "of the variance"], [[n, f"{v:.1%}"] for n, v in knowledge.items()])


if __name__ == "__main__":
    main()
