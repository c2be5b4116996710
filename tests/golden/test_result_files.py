"""The JSON of result files: keys and types of values of a network's and a twin's run."""

import json
from pathlib import Path

import pytest

from edp.config.experiment import load_experiment
from edp.config.twin import load_twin_experiment
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.storage import read_json
from edp.testing.twins import sample_actuators
from edp.workflows.train_evaluate import evaluate, train
from edp.workflows.twin import train_twin

FILE = Path(__file__).parent / "result_files.json"
NETWORK = (
    'task.features={name="rig", channels=["lever_1", "lever_2", "speed_1", "speed_2"]}',
    'task.targets=["speed_1", "speed_2"]',
    "task.horizons=[1, 5]",
    "training.epochs=2",
    "training.updates=3",
    'training.chunks={regime="chunk",length=16,batch=2,burn_in=5}',
    'model.backbone={kind="lstm",units=4}',
    'model.output={kind="normal"}',
    'training.loss={kind="heteroscedastic"}',
    "model.blocks=[]",
    "model.window=8",
    "evaluation.history=4",
    'evaluation.baselines=["persistence", "ridge_arx"]',
)
TWIN = (
    *("twin.kind=recurrent", "twin.units=6", "twin.prefix_ticks=20", "training.batch=4", "training.lengths_s=[0.2]"),
    *(
        "training.updates=[6]",
        "training.validate_every=3",
        "evaluation.duration_s=4",
        "evaluation.starts=2",
        "evaluation.at_s=[1, 4]",
    ),
)


def write_logs(folder):
    for seed in range(6):
        write_recording(sample_actuators(seed=seed), folder / f"log_{seed}.parquet")
    return DataSource.from_path(folder)


def write_runs(folder):
    """A run of each kind, with all result files."""
    source = write_logs(folder / "logs")
    train(source, load_experiment(preset="quick", overrides=NETWORK), folder / "network")
    evaluate(folder / "network")
    train_twin(source, load_twin_experiment(None, TWIN), folder / "twin")
    return folder


def structure_of(value):
    """Keys with the structure of their values; of a list the structures of different entries."""
    if isinstance(value, dict):
        return {key: structure_of(entry) for key, entry in value.items()}
    if isinstance(value, list):
        seen = []
        for entry in map(structure_of, value):
            if entry not in seen:
                seen.append(entry)
        return seen
    return "null" if value is None else type(value).__name__


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    return write_runs(tmp_path_factory.mktemp("runs"))


def test_result_files_keep_their_form(runs):
    files = sorted(path.relative_to(runs).as_posix() for path in runs.rglob("*.json"))
    found = {name: structure_of(read_json(runs / name)) for name in files}
    known = json.loads(FILE.read_text())
    assert list(found) == list(known)
    for name, structure in found.items():
        assert structure == known[name], name
