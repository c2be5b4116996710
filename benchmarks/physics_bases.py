"""What do physics bases know, and what do they bring a network?

First each base alone on held-out recordings: its error against the true velocity k samples ahead, as a share of how far
the velocity goes meanwhile (1 is what saying "no change" gets). Then the same small network with each base, trained
alike, one network for k = 1 and 10. The simulator logs joint angles and rates without noise, so a base that reads them
knows more than one that reads sensors: a network that reads the same channels as features stands beside them.
"""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from common import finish, parser, table, verdict
from edp.config.experiment import TaskSettings, load_experiment
from edp.data.features import FG2, FeatureSet
from edp.data.prepared import prepare
from edp.data.task import TargetMode, Task
from edp.networks import stream_predictions
from edp.networks.physics import ForceSpec, HybridPhysicsSpec, KinematicSpec, PhysicsSpec
from edp.networks.physics.base import POSES
from edp.recording import Recording
from edp.sim import load_machine
from edp.training import fit
from edp.workflows.train_evaluate import DataSource, SimulationOrder, simulate_data_set

HORIZONS = (1, 10)
MACHINE = "M22"
BASES: dict[str, PhysicsSpec] = {
    "kinematic": KinematicSpec(machine=MACHINE),
    "kinematic, strokes": KinematicSpec(machine=MACHINE, pose="strokes"),
    "force, literal": ForceSpec(machine=MACHINE, load="none", fade_s=0.0),
    "force, gravity": ForceSpec(machine=MACHINE, load="gravity", fade_s=0.0),
    "force": ForceSpec(machine=MACHINE, fade_s=0.0),
    "force, fading": ForceSpec(machine=MACHINE, fade_s=0.03),
    "hybrid, literal": HybridPhysicsSpec(machine=MACHINE, load="none", fade_s=0.0),
    "hybrid, gravity": HybridPhysicsSpec(machine=MACHINE, load="gravity", fade_s=0.0),
    "hybrid": HybridPhysicsSpec(machine=MACHINE, fade_s=0.0),
    "hybrid, fading": HybridPhysicsSpec(machine=MACHINE, fade_s=0.03),
    "hybrid, coupled": HybridPhysicsSpec(machine=MACHINE, coupled=True, fade_s=0.0),
    "hybrid, coupled, fading": HybridPhysicsSpec(machine=MACHINE, coupled=True, fade_s=0.03),
}
WITH_JOINTS = FeatureSet("FG2 and joints", (*FG2.channels, *POSES["angles"]), FG2.derived)
# Name, base, mode, features.
NETWORKS: list[tuple[str, str | None, TargetMode, str | FeatureSet]] = [
    ("none", None, TargetMode.DELTA, "FG2"),
    ("none, joints as features", None, TargetMode.DELTA, WITH_JOINTS),
    *(
        (name, name, TargetMode.DELTA, "FG2")
        for name in ("kinematic", "force, literal", "force, gravity", "force", "hybrid, literal", "hybrid")
    ),
    ("hybrid, coupled, fading", "hybrid, coupled, fading", TargetMode.DELTA, "FG2"),
    ("none, absolute", None, TargetMode.ABSOLUTE, "FG2"),
    ("kinematic, absolute", "kinematic", TargetMode.ABSOLUTE, "FG2"),
    ("hybrid, absolute", "hybrid", TargetMode.ABSOLUTE, "FG2"),
]


def task_of(physics: PhysicsSpec | None, mode: TargetMode, features: str | FeatureSet) -> Task:
    """Velocities of the cylinders at `HORIZONS`."""
    task = TaskSettings(horizons=HORIZONS, mode=mode).resolve(100.0)
    task = replace(task, features=features) if isinstance(features, FeatureSet) else task
    extra = () if physics is None else physics.channels()
    return replace(task, physics=tuple(name for name in extra if name not in task.features.inputs))


def said(spec: PhysicsSpec, recording: Recording) -> NDArray[np.float64]:
    """What a base says of a recording, ``(time, horizon, 3)``."""
    task = task_of(spec, TargetMode.ABSOLUTE, "FG2")
    base = spec.build(task).double()
    base.read()
    x = torch.from_numpy(task.series(recording).inputs)[None].double()
    base.settle([x[0]])
    with torch.no_grad():
        values: NDArray[np.float64] = base(x, base.initial_state(1, x))[0][0].numpy()
    return values


def alone(recordings: list[Recording]) -> dict[str, Any]:
    """Each base's error as a share of the change of velocity, and its mean error in mm/s, by horizon and cylinder."""
    truth = [said(BASES["kinematic"], recording)[:, 0] for recording in recordings]
    found = {}
    for name, spec in BASES.items():
        spoken = [said(spec, recording) for recording in recordings]
        found[name] = {}
        for h, k in enumerate(HORIZONS):
            error = np.concatenate([z[1:-k, h] - v[k + 1 :] for z, v in zip(spoken, truth)])
            change = np.concatenate([v[k:] - v[:-k] for v in truth])
            share = np.sqrt((error**2).mean(axis=0) / (change**2).mean(axis=0))
            found[name][str(k)] = {"share": share.tolist(), "mean_mm_s": (1e3 * error.mean(axis=0)).tolist()}
    return found


def trained(recordings: list[Recording], row: tuple[Any, ...], seed: int, quick: bool) -> list[list[float]]:
    """Mean absolute errors in mm/s on the test recordings, by horizon and cylinder."""
    _, base, mode, features = row
    changes = [f"training.seed={seed}", "training.epochs=4", f"training.updates={20 if quick else 200}"]
    changes += ['model.backbone={kind="hybrid", channels=[32], kernel=5, units=32}']
    experiment = load_experiment(None, "quick", changes)
    model = replace(experiment.model, physics=None if base is None else BASES[base])
    data = prepare(recordings, task_of(model.physics, mode, features), experiment.split, model.window)
    net = fit(data, model, experiment.training).predictor
    errors = []
    for part, values in zip(data.test, stream_predictions(net, data.test)):
        ticks = part.samples - max(HORIZONS)
        future = np.stack([part.targets[k : k + ticks] for k in HORIZONS], axis=1)
        errors.append(np.abs(values[:ticks] - future)[model.window :])
    mean: list[list[float]] = (1e3 * np.concatenate(errors).mean(axis=0)).tolist()
    return mean


def main() -> None:
    arguments = parser(__doc__ or "").parse_args()
    quick, seed = arguments.quick, arguments.seed
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.data or Path(temporary) / "data"
        minutes, count = (4.0, 8) if quick else (32.0, 16)
        simulate_data_set(folder, SimulationOrder(minutes=minutes, recordings=count, seed=seed))
        recordings = list(DataSource.of(folder).read())
    bases = alone(recordings)
    keys = [f"k={k} {axis}" for k in HORIZONS for axis in ("boom", "arm", "bucket")]
    print("base alone: error as a share of the change of velocity")
    table(["base", *keys], [[n, *(v for k in HORIZONS for v in row[str(k)]["share"])] for n, row in bases.items()])
    measured = np.concatenate([r.select([f"CylVels_{i + 1}" for i in range(3)]) for r in recordings])
    noise = np.concatenate([said(BASES["kinematic"], r)[:, 0] for r in recordings]) - measured
    networks: dict[str, Any] = {}
    for s in (seed,) if quick else (seed, seed + 1):
        for row in NETWORKS[:4] if quick else NETWORKS:
            networks.setdefault(row[0], []).append(trained(recordings, row, s, quick))
            mean = np.mean(networks[row[0]][-1], axis=1)
            print(f"seed {s}, {row[0]}: " + ", ".join(f"k={k} {e:.3f}" for k, e in zip(HORIZONS, mean)), flush=True)
    print("\nnetworks: mean absolute error in mm/s, means over seeds")
    means = {name: np.mean(values, axis=0) for name, values in networks.items()}
    table(["network", *keys, "k=1", "k=10"], [[n, *m.ravel(), *m.mean(axis=1)] for n, m in means.items()])
    sensor = load_machine(MACHINE).sensors.velocity
    boom = float(bases["hybrid, coupled"]["1"]["share"][0])
    verdicts = [
        verdict("kinematic base less measured velocity", float(noise.std()), sensor, "<= 1.05", "m/s rms", quick),
        verdict("error of the coupled base over 10 ms, boom", boom, 1.0, "<= 0.3", "of the change", quick),
    ]
    finish("physics_bases", verdicts, seed, {"bases": bases, "networks": networks})


if __name__ == "__main__":
    main()
