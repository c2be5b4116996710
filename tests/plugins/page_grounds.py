"""What the Python blocks of a page of docs/ take for given: files in the folder they run in, and names.

A page that has no entry here stands by itself. Nothing of a block is replaced but lengths, which `SHORTER` lists.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_monitors import fitted_monitor

import edp
from edp.ir.rls import AdaptationSpec
from edp.logs import write_recording
from edp.logs.source import load_signal_map
from edp.monitor.monitor_file import save_monitor
from edp.networks.backbones import HybridSpec
from edp.networks.heads import MlpHead
from edp.networks.predictor import ModelSpec, build_model
from edp.networks.twin import TWINS
from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.testing.monitor import rig_sessions
from edp.testing.twins import sample_actuators, sample_twin
from edp.training.bundle import make_bundle, save_bundle
from edp.training.twin_bundle import TwinBundle, save_twin
from edp.workflows.adaptation import adapt

Names = dict[str, Any]
Ground = Callable[[Path, pytest.FixtureRequest], Names]
SMALL = {
    "training.epochs": 1,
    "training.updates": 5,
    "model.window": 12,
    "model.backbone": {"kind": "hybrid", "channels": [8], "kernel": 3, "units": 8},
}
SHORTER: Mapping[str, Mapping[str, str]] = {
    "simulate_recordings": {
        "duration_s=120.0": "duration_s=2.0",
        "minutes=60.0, recordings=30": "minutes=0.1, recordings=2",
        "workers=4": "workers=1",
        "simulation.run(2000)": "simulation.run(60)",
        "simulation.run(500)": "simulation.run(30)",
    },
    "reinforcement_learning": {"num_envs=64": "num_envs=2"},
    "choose_channels": {
        "ScreeningSpec(horizon=10)": "ScreeningSpec(horizon=1, max_lag=20, information_samples=200)",
    },
    "tune_training": {'"training.epochs": 20': '"training.epochs": 1'},
}
"""Lengths of a page that a test cannot wait for, and what it runs instead."""


def lever_rig(recordings: int = 6) -> edp.Recordings:
    """A lever in steps, and a speed that follows it; 4 s each."""
    lever = np.repeat(np.random.default_rng(0).uniform(-1, 1, size=(recordings, 20)), 20, axis=1)
    speed = np.stack([np.convolve(row, 0.01 * 0.9 ** np.arange(40))[: len(row)] for row in lever])
    arrays = np.dstack([lever, speed])
    return edp.Recordings.from_arrays(arrays, rate_hz=100, names=["lever", "speed"], units=["1", "m/s"])


def trained(out: Path) -> edp.Model:
    """A run of that rig."""
    train, test = lever_rig().split()
    return edp.train(train, targets=["speed"], horizons=[1], test=test, out=out, preset="quick", settings=SMALL)


def lever_logs(folder: Path) -> None:
    """The same rig as CSV files with a map beside them, as `edp init` would leave it."""
    folder.mkdir(parents=True)
    for number, recording in enumerate(lever_rig(2)):
        rows = np.column_stack([np.arange(recording.samples) / 100.0, recording.values])
        np.savetxt(folder / f"day_{number}.csv", rows, delimiter=",", header="t,lever,speed", comments="", fmt="%.9g")
    text = 'time = "t"\ntime_unit = "s"\n'
    for name, kind, unit in (("lever", "generic", "1"), ("speed", "velocity", "m/s")):
        text += f'[channels.{name}]\ncolumn = "{name}"\nkind = "{kind}"\nunit = "{unit}"\n'
    Path("map.toml").write_text(text, encoding="utf-8")


def adapt_on_board(folder: Path, request: pytest.FixtureRequest) -> Names:
    model = trained(folder / "runs" / "first")
    adapt(folder / "runs" / "first", folder / "runs" / "first_adapted", AdaptationSpec(rank=1, noise=1.0))
    return {"inputs": lever_rig()[0].select(model.inputs)[0]}


def fit_budget(folder: Path, request: pytest.FixtureRequest) -> Names:
    tiny, training = (request.getfixturevalue(name) for name in ("tiny", "tiny_training"))
    backbone = HybridSpec(channels=(32, 16), kernel=2, units=32)
    teacher = build_model(tiny.task, ModelSpec(backbone=backbone, head=MlpHead(hidden=16), window=10), tiny.scaler(), 0)
    save_bundle(make_bundle(teacher.eval(), tiny), folder / "runs" / "teacher" / "bundle")
    few = replace(training, epochs=1, updates=2, chunks=replace(training.chunks, length=64, batch=16))
    return {"data": tiny, "training": few, "network": teacher}


def watch_machine(folder: Path, request: pytest.FixtureRequest) -> Names:
    sessions = rig_sessions(12, 2000, seed=1)
    save_monitor(fitted_monitor(sessions), folder / "monitors" / "rig")
    channels = sessions[0].channels
    entries = [f'[channels.{c.name}]\ncolumn = "{c.name}"\nkind = "{c.kind}"\nunit = "{c.unit}"\n' for c in channels]
    (folder / "map.toml").write_text("sample_time_s = 0.01\n" + "".join(entries), encoding="utf-8")
    (folder / "logs" / "today").mkdir(parents=True)
    names = ",".join(c.name for c in channels)
    path = folder / "logs" / "today" / "monday.csv"
    np.savetxt(path, sessions[0].values, delimiter=",", header=names, comments="", fmt="%.9g")
    return {}


def monitor(folder: Path, request: pytest.FixtureRequest) -> Names:
    sessions = rig_sessions(12, 2000, seed=1)
    channels = [replace(sessions[0].channels[0], name="CylVels_1"), *sessions[0].channels[1:]]
    channels[1] = replace(channels[1], name="CylPressures_1")
    named = [replace(session, channels=tuple(channels)) for session in sessions]
    save_monitor(fitted_monitor(named), folder / "monitors" / "m22")
    values = named[0].values.copy()
    values[700:, 0] += 5 * np.std(values[:, 0])  # whatever that is, it is not healthy
    return {"recording": replace(named[0], values=values)}


def which_model(folder: Path, request: pytest.FixtureRequest) -> Names:
    spec = next(iter(TWINS.values()))()
    twin = sample_twin(spec, sample_actuators(600))[0]
    series = twin.channels.task().series(sample_actuators(600))
    commands, measured = series.inputs[None], series.targets[None]
    save_twin(TwinBundle(spec, twin), folder / "runs" / "twin")
    return {
        "commands": commands[:, :200],
        "measured": measured[:, :200],
        "command": commands[:, 200],
        "measured_row": measured[:, 200],
    }


def exported(folder: Path, target: str) -> edp.Model:
    model = trained(folder / "runs" / "first")
    model.export(target, folder / "exported")
    return model


def deploy_casadi(folder: Path, request: pytest.FixtureRequest) -> Names:
    pytest.importorskip("casadi")
    if shutil.which("cc") is None:
        pytest.skip("no C compiler `cc`")
    model = exported(folder, "casadi")
    request.getfixturevalue("monkeypatch").syspath_prepend(str(folder / "exported"))
    for name in ("edp_casadi", "edp_horizon"):
        sys.modules.pop(name, None)
    inputs = len(model.inputs)
    carry, feed, by = np.zeros(inputs), np.eye(inputs, 1), np.zeros((20, 3, inputs))
    names = {"u": np.zeros(inputs), "first": np.zeros(inputs), "base": np.zeros((20, inputs))}
    return {**names, "carry": carry, "feed": feed, "by": by}


def deploy_onnx(folder: Path, request: pytest.FixtureRequest) -> Names:
    pytest.importorskip("onnxruntime")
    model = exported(folder, "onnx")
    return {"rows": lever_rig()[0].select(model.inputs)[:20].astype(np.float32)}


def repair_logs(folder: Path, request: pytest.FixtureRequest) -> Names:
    from scipy.io import savemat

    rows = np.tile(lever_rig(1)[0].values, (150, 1))  # the page asks for the first 60,000 rows
    savemat(folder / "drive.mat", {"t": np.arange(len(rows)) / 100.0, "lever": rows[:, 0], "speed": rows[:, 1]})
    lever_logs(folder / "logs")
    return {"signal_map": load_signal_map(folder / "map.toml")}


def choose_channels(folder: Path, request: pytest.FixtureRequest) -> Names:
    (folder / "logs").mkdir()
    rng = np.random.default_rng(3)
    for number in range(6):
        walk = np.cumsum(rng.normal(size=(600, 24)), axis=0) * 0.02
        scale = np.array([0.2 if channel.unit == "m/s" else 1e6 for channel in TABLE_A1.values()])
        recording = Recording(f"d{number}", tuple(TABLE_A1.values()), (walk * scale).astype(np.float32), 100.0)
        write_recording(recording, folder / "logs" / f"d{number}.parquet")
    return {}


def large_stores(folder: Path, request: pytest.FixtureRequest) -> Names:
    rows = folder / "store" / "rows"
    rows.mkdir(parents=True)
    np.arange(120, dtype="<f4").tofile(rows / "KEY.f32")
    return {"np": np, "first": 20, "samples": 10, "channels": 4}


def tune_training(folder: Path, request: pytest.FixtureRequest) -> Names:
    lever_logs(folder / "logs")
    return {}


def compare_runs(folder: Path, request: pytest.FixtureRequest) -> Names:
    train, test = lever_rig().split()
    for number, name in enumerate(("first", "second")):
        settings = {**SMALL, "training.seed": number}
        place = folder / "runs" / name
        task = {"targets": ["speed"], "horizons": [1]}
        model = edp.train(train, **task, test=test, out=place, preset="quick", settings=settings)
        model.evaluate()
    return {}


def intervals(folder: Path, request: pytest.FixtureRequest) -> Names:
    lever_logs(folder / "logs")
    train, test = lever_rig().split()
    quantiles = {"model.output.kind": "quantiles", "training.loss.kind": "quantile"}
    task = {"targets": ["speed"], "horizons": [1]}
    place = folder / "runs" / "intervals"
    edp.train(train, **task, test=test, out=place, preset="quick", settings={**SMALL, **quantiles})
    return {}


def deploy_pytorch(folder: Path, request: pytest.FixtureRequest) -> Names:
    trained(folder / "runs" / "first")
    lever_logs(folder / "logs")
    return mpc(folder, request)


def mpc(folder: Path, request: pytest.FixtureRequest) -> Names:
    spec = next(iter(TWINS.values()))()
    made = sample_twin(spec, sample_actuators(600))[0]
    series = made.channels.task().series(sample_actuators(600))
    commands, measured = series.inputs[None], series.targets[None]
    save_twin(TwinBundle(spec, made), folder / "runs" / "twin")
    return {
        "commands": commands[:, :200],
        "measured": measured[:, :200],
        "command": commands[:, 200],
        "measured_row": measured[:, 200],
    }


GROUNDS: Mapping[str, Ground] = {
    part.__name__: part
    for part in (
        adapt_on_board, choose_channels, compare_runs, deploy_casadi, deploy_onnx, deploy_pytorch, fit_budget,
        intervals, large_stores, which_model, monitor, mpc, repair_logs, tune_training, watch_machine,
    )
}  # fmt: skip
"""By the stem of the page."""


def ground_of(page: Path, folder: Path, request: pytest.FixtureRequest) -> Names:
    """Lay out what a page takes for given; the names that its blocks find."""
    torch.manual_seed(0)
    return GROUNDS[page.stem](folder, request) if page.stem in GROUNDS else {}
