"""Commands on a real Ray cluster of three nodes, one of which is killed in the middle: what one process gives."""

import json
import threading
import time
from pathlib import Path

import pytest
from ray_nodes import needs_ray, three_nodes

from edp.config.experiment import load_experiment
from edp.errors import ConfigError
from edp.jobs import IN_PROCESS, Workers, cluster
from edp.logs.source import DataSource
from edp.logs.store import read_store
from edp.progress import SilentProgress
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.workflows.feature_selection.select import Listeners, SelectionOrder, select_features
from edp.workflows.pretraining import Pretrain, pretrain
from edp.workflows.train_evaluate import evaluate
from edp.workflows.transfer import FinetuneRequest, FinetuneSpec, finetune

pytestmark = pytest.mark.processes

SETTINGS = (
    'split.kind="machines"',
    "task.horizons=[10]",
    "training.epochs=2",
    "training.updates=8",
    'training.chunks={regime="chunk",length=40,batch=4,burn_in=20}',
    'model.backbone={kind="lstm",units=4}',
    "model.head.hidden=4",
    "model.window=20",
    "evaluation.history=10",
    'evaluation.baselines=["persistence","ridge_arx","small_mlp"]',
)
ORDER = SimulationOrder(minutes=1.8, recordings=6, seed=5, family=3)


class Plug:
    """Kills the third node when something happened for the first time, and puts a new one in its place afterwards."""

    def __init__(self, nodes):
        self.nodes, self.pulled = nodes, 0

    def pull(self, *_):
        if not self.pulled:
            self.pulled = 1
            self.nodes.kill(len(self.nodes.groups) - 1)

    def mend(self):
        import ray

        assert self.pulled
        self.pulled = 0
        ray.init(address=self.nodes.address, log_to_driver=False)
        until = time.monotonic() + 120
        while ray.cluster_resources().get("CPU", 0) > 2 and time.monotonic() < until:
            time.sleep(0.5)  # until the loss is noticed
        self.nodes.join(3)
        ray.shutdown()


class PullingProgress(SilentProgress):
    """Progress that pulls a plug."""

    def __init__(self, plug):
        self.plug = plug

    def note(self, sentence):
        """Pull the plug."""
        self.plug.pull()

    def step(self, done, **values):
        """Pull the plug once something is done."""
        if done:
            self.plug.pull()


@pytest.fixture(scope="module")
def nodes():
    with pytest.MonkeyPatch.context() as patch, three_nodes(patch, Path(__file__).parent) as running:
        yield running


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_every_command_survives_a_killed_node_with_the_results_of_one_process(nodes, tmp_path):
    there, plug = Workers(cluster=nodes.address), Plug(nodes)
    one = tmp_path / "one"
    paths = simulate_data_set(one / "logs", ORDER, workers=IN_PROCESS)
    made = simulate_data_set(tmp_path / "logs", ORDER, there, plug.pull)
    assert [path.read_bytes() for path in made] == [path.read_bytes() for path in paths]
    plug.mend()

    source = DataSource.from_path(one / "logs")
    source.store(tmp_path / "store", there, PullingProgress(plug))
    source.store(one / "store")
    digests = [[entry.digest for entry in read_store(folder / "store")] for folder in (tmp_path, one)]
    assert digests[0] == digests[1]
    plug.mend()

    stored = DataSource.from_path(one / "store")
    assert stored.inspect(PullingProgress(plug), there) == stored.inspect()
    plug.mend()

    order = SelectionOrder(pictures=False)
    apart = select_features(stored, tmp_path / "screen", order, Listeners(logs=PullingProgress(plug)), there)
    together = select_features(stored, one / "screen", order)
    assert apart.screening.proposal.kept == together.screening.proposal.kept
    plug.mend()

    experiment = load_experiment(preset="quick", overrides=SETTINGS)
    started = threading.Thread(target=_pull_when, args=(tmp_path / "run" / "config.toml", plug))
    started.start()
    found = pretrain(stored, experiment, Pretrain(), tmp_path / "run", workers=there)
    started.join()
    usual = pretrain(stored, experiment, Pretrain(), one / "run")
    assert found == usual
    assert _digest(tmp_path / "run") == _digest(one / "run")
    plug.mend()

    scored = evaluate(tmp_path / "run", progress=PullingProgress(plug), workers=there)
    evaluate(one / "run")
    assert _scores(scored) == _scores(one / "run")
    plug.mend()

    tuned = FinetuneRequest(
        spec=FinetuneSpec(single_phase_epochs=2, batch=4), method="full", baselines=("low_rank", "linear_probe")
    )
    logs = DataSource.from_path(paths[0])
    started = threading.Thread(target=_pull_when, args=(tmp_path / "tuned" / "config.toml", plug))
    started.start()
    found = finetune(tmp_path / "run", logs, tuned, tmp_path / "tuned", workers=there)
    started.join()
    usual = finetune(one / "run", logs, tuned, one / "tuned")
    assert found.methods == usual.methods


def _pull_when(file, plug):
    until = time.monotonic() + 600
    while not file.exists() and time.monotonic() < until:
        time.sleep(0.05)
    plug.pull()


def _digest(run):
    return weights_digest(load_bundle(run).predictor)


def _scores(folder):
    models = json.loads((folder / "scores.json").read_text())["models"]
    return {name: model["overall"] for name, model in models.items()}


@needs_ray
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_node_with_another_version_is_refused_with_one_error(nodes, monkeypatch):
    monkeypatch.setattr(cluster, "code_version", lambda whole: "0.0.9+another")  # here; nodes have their own
    with pytest.raises(ConfigError, match=r"node .* has other code or versions: code .*install the same there"):
        Workers(cluster=nodes.address).open()
