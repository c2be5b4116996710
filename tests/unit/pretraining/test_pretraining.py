"""Pretraining: machines apart, gradients of the meta-learners, and that it goes on after a stop to the same bits."""

import dataclasses
import re
import shutil

import numpy as np
import pytest
import torch
from noted_progress import NotedProgress

from edp.config.experiment import load_experiment
from edp.data.chunks import stack
from edp.data.episodes import EpisodeSampler
from edp.errors import BundleError, ConfigError, DataError, StorageError
from edp.evaluation.foundation_file import FoundationFile
from edp.networks.decomposition import decompose
from edp.networks.predictor import build_model
from edp.report import build_report
from edp.storage import read_json
from edp.training import load_bundle
from edp.training.adaptation import adapt, loss_with
from edp.training.objective import Objective
from edp.training.strategy import EpisodicStrategy
from edp.training.validation import validation_scores
from edp.wording import number
from edp.workflows.pretraining import PRETRAININGS, MetaSpec, Pretrain, pretrain
from edp.workflows.train_evaluate import evaluate
from edp.workflows.transfer import FinetuneRequest, FinetuneSpec, finetune

pytestmark = pytest.mark.processes

META = MetaSpec(inner_learning_rate=0.1, inner_steps=2, shots=2)


class Pulled(Exception):
    pass


@pytest.fixture(scope="module", params=list(PRETRAININGS))
def made(request, machines, experiment, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param) / "run"
    return folder, pretrain(machines, experiment, Pretrain(method=request.param, meta=META), folder)


@pytest.fixture
def episode(prepared_machines, experiment):
    """A network in double precision, its objective, and support and query of one machine."""
    net = build_model(prepared_machines.task, experiment.model, prepared_machines.scaler(), 3).double().eval()
    objective = Objective(experiment.training, net.code)
    objective.weights = objective.weights.double()
    sampler = EpisodeSampler(prepared_machines.train, (2,), experiment.training.chunks, 2, 0)
    batch = next(iter(sampler.epoch(0)))
    parts = [torch.from_numpy(part) for part in (batch.inputs, batch.future, batch.valid)]
    parts = [part.double() if part.is_floating_point() else part for part in parts]
    return net, objective, tuple(p[:2] for p in parts), tuple(p[2:4] for p in parts)


def strategy_of(method, net, experiment, meta=META):
    strategy = PRETRAININGS[method]().strategy(meta, None)
    strategy.begin(net, experiment.training)
    return strategy


def gradient(strategy, episode):
    net, objective, support, query = episode
    net.zero_grad()
    cost = strategy.cost(net, objective, support, query)
    cost.backward()
    return cost.item(), {name: p.grad.clone() for name, p in net.named_parameters()}


def test_every_method_leaves_a_run_and_errors_on_machines_that_it_never_saw(made, machines):
    folder, found = made
    assert found == FoundationFile.read(folder)
    assert {part: size.machines for part, size in found.data.items()} == {"train": 4, "validation": 1, "test": 1}
    names = read_json(folder / "provenance.json")["data"]
    seen = [{name.split("_")[0] for name in names[part]["names"]} for part in ("train", "validation", "test")]
    assert not seen[0] & seen[1] | seen[0] & seen[2] | seen[1] & seen[2]
    contexts = found.unseen.contexts
    assert [row.seconds for row in contexts] == [0.5, 2.0, 5.0]
    assert found.unseen.dropped == (10.0, 30.0, 60.0)
    assert all(np.isfinite(row.mae) for row in contexts)
    assert (evaluate(folder, baselines=()) / "scores.json").is_file()


def test_the_report_shows_the_machines_that_were_never_seen(made, tmp_path):
    folder, found = made
    copied = tmp_path / "run"
    shutil.copytree(folder, copied)
    page = build_report(copied).read_text()
    assert '<section id="unseen">' in page
    for name, mae in found.unseen.machines.items():
        shown = re.search(rf"<td>{name}</td><td>([\d.]+)</td>", page)
        assert float(shown[1]) == pytest.approx(mae, rel=5e-3), name
    for row in found.unseen.contexts:
        assert f"<td>{number(row.mae)}</td>" in page
    (copied / "foundation.json").write_text('{"label": "Joint"}')
    with pytest.raises(StorageError, match="edp train pretrain"):
        build_report(copied)
    (copied / "foundation.json").unlink()
    assert '<section id="unseen">' not in build_report(copied).read_text()


def test_a_stopped_pretraining_goes_on_to_the_same_bits(made, machines, experiment, tmp_path):
    folder, found = made
    order = Pretrain(method=found.method, meta=META)

    def pull(done, **values):
        if "validation_mae" in values and done == 1:
            raise Pulled

    with pytest.raises(Pulled):
        pretrain(machines, experiment, order, tmp_path / "run", NotedProgress(pull))
    again = pretrain(machines, experiment, order, tmp_path / "run")
    assert again == found
    ends = [load_bundle(place).predictor.state_dict() for place in (folder, tmp_path / "run")]
    assert all(torch.equal(ends[0][key], ends[1][key]) for key in ends[0])


def test_few_steps_take_rate_and_head_of_the_meta_learning(machines, experiment, tmp_path):
    meta = dataclasses.replace(META, inner_learning_rate=0.07, head_only=True)
    pretrain(machines, experiment, Pretrain(method="fomaml", meta=meta), tmp_path / "meta")
    spec = FinetuneSpec(inner_steps=3, batch=4, check_signs=False)
    finetune(tmp_path / "meta", machines, FinetuneRequest(spec=spec, method="few_steps"), tmp_path / "tuned")
    tuned = load_bundle(tmp_path / "tuned").predictor
    before = dict(load_bundle(tmp_path / "meta").predictor.named_parameters())
    settings = load_experiment(tmp_path / "tuned" / "config.toml", preset=None)
    assert settings.training.optimizer.learning_rate == 0.07
    assert settings.training.epochs == 3
    moved = {name for name, tensor in tuned.named_parameters() if not torch.equal(tensor, before[name])}
    assert moved <= set(decompose(tuned).head)


def test_second_order_gradient_is_that_of_the_error_after_adaptation(episode, experiment):
    """Held to differences of the cost itself, along a random direction of all weights."""
    net, objective, support, query = episode
    strategy = strategy_of("maml", net, experiment)
    _, found = gradient(strategy, episode)
    torch.manual_seed(0)
    way = {name: torch.randn_like(p) for name, p in net.named_parameters()}
    slope = sum(float((found[name] * way[name]).sum()) for name in way)

    def cost(step):
        with torch.no_grad():
            for name, parameter in net.named_parameters():
                parameter.add_(way[name], alpha=step)
        value = float(strategy.cost(net, objective, support, query).detach())
        with torch.no_grad():
            for name, parameter in net.named_parameters():
                parameter.add_(way[name], alpha=-step)
        return value

    assert slope == pytest.approx((cost(1e-7) - cost(-1e-7)) / 2e-7, rel=1e-5)
    _, first = gradient(strategy_of("fomaml", net, experiment), episode)
    assert any((found[name] - first[name]).abs().max() > 1e-6 for name in found)


def by_hand(net, objective, pieces, steps):
    """Gradient descent on the parameters themselves, undone at the end; the weights it came to."""
    kept = {name: p.detach().clone() for name, p in net.named_parameters()}
    for piece, rate in zip(pieces, steps, strict=True):
        net.zero_grad()
        answer, features, _, _ = net.forward_features(piece[0], net.initial_state(len(piece[0]), piece[0]))
        objective.evaluate(answer, piece[1], features, piece[2]).backward()
        with torch.no_grad():
            for parameter in net.parameters():
                parameter.sub_(parameter.grad, alpha=rate)
    came = {name: p.detach().clone() for name, p in net.named_parameters()}
    net.zero_grad()
    return kept, came


def put(net, weights):
    with torch.no_grad():
        for name, parameter in net.named_parameters():
            parameter.copy_(weights[name])


def test_first_order_gradient_is_the_querys_at_the_adapted_weights(episode, experiment):
    net, objective, support, query = episode
    cost, found = gradient(strategy_of("fomaml", net, experiment), episode)
    kept, came = by_hand(net, objective, [support, support], META.steps)
    put(net, came)
    answer, features, _, _ = net.forward_features(query[0], net.initial_state(2, query[0]))
    loss = objective.evaluate(answer, query[1], features, query[2])
    loss.backward()
    assert cost == pytest.approx(loss.item(), rel=1e-12)
    for name, parameter in net.named_parameters():
        torch.testing.assert_close(found[name], parameter.grad)
    put(net, kept)


def test_reptile_goes_the_way_to_the_adapted_weights(episode, experiment):
    net, objective, support, query = episode
    _, found = gradient(strategy_of("reptile", net, experiment), episode)
    kept, came = by_hand(net, objective, [support, query], META.steps)
    put(net, kept)
    for name in kept:
        torch.testing.assert_close(found[name], (kept[name] - came[name]) / sum(META.steps))


def test_with_the_head_alone_the_backbone_learns_but_does_not_adapt(episode, experiment):
    net = episode[0]
    strategy = strategy_of("maml", net, experiment, dataclasses.replace(META, head_only=True))
    assert set(strategy.start_of(net)) == set(decompose(net).head)
    _, found = gradient(strategy, episode)
    assert all(found[name].abs().max() > 0 for name in decompose(net).encoding)


def test_adaptation_lowers_the_loss_of_its_support_and_leaves_the_network(episode):
    net, objective, support, _ = episode
    start = dict(net.named_parameters())
    before = {name: p.detach().clone() for name, p in start.items()}
    weights = adapt(net, start, objective, support, (0.1,) * 5)
    assert loss_with(net, weights, objective, support) < loss_with(net, start, objective, support)
    assert all(torch.equal(before[name], p) for name, p in net.named_parameters())


def test_an_epoch_is_chosen_by_the_error_after_adaptation(prepared_machines, experiment):
    """The judgement is that of a network that was adapted by hand to the first half of each series."""
    net = build_model(prepared_machines.task, experiment.model, prepared_machines.scaler(), 3).eval()
    objective = Objective(experiment.training, net.code)
    strategy = strategy_of("fomaml", net, experiment)
    assert isinstance(strategy, EpisodicStrategy)
    before = {name: p.detach().clone() for name, p in net.named_parameters()}
    found = strategy.judge(net, objective, prepared_machines)
    assert all(torch.equal(before[name], p) for name, p in net.named_parameters())
    support, rest = strategy._halves(net, prepared_machines.validation)
    assert all(part.samples == 450 for part in rest)
    _, came = by_hand(net, objective, [support] * META.inner_steps, META.steps)
    put(net, came)
    expected = validation_scores(net, rest, experiment.training, prepared_machines)
    assert found == pytest.approx(expected, rel=1e-5)


def test_a_start_is_a_candidate_and_another_start_another_run(machines, experiment, tmp_path):
    still = dataclasses.replace(
        experiment, training=dataclasses.replace(experiment.training, epochs=1, updates=1, clip_norm=1e-12)
    )
    pretrain(machines, experiment, Pretrain(), tmp_path / "first")
    for method in ("joint", "fomaml"):
        order = Pretrain(method=method, meta=META, start=tmp_path / "first")
        pretrain(machines, still, order, tmp_path / method)
        facts = read_json(tmp_path / method / "provenance.json")["strategy"]
        assert facts["method"] == method
        assert len(facts["start"]) > 10
        ends = [load_bundle(tmp_path / name).predictor.state_dict() for name in ("first", method)]
        for key, tensor in ends[0].items():
            torch.testing.assert_close(tensor, ends[1][key], rtol=0, atol=0.1)


def test_streams_are_carried_for_a_minute_unless_the_settings_say_otherwise(made, experiment):
    _, found = made
    assert found.carried == (150 if found.method in ("joint", "codes") else 0)


def test_what_cannot_be_is_refused(machines, experiment, tmp_path, prepared_machines):
    with pytest.raises(ConfigError, match=r'split\.kind = "machines"'):
        pretrain(machines, load_experiment(preset="quick"), Pretrain(), tmp_path / "out")
    with pytest.raises(ConfigError, match="head_only"):
        PRETRAININGS["reptile"]().strategy(MetaSpec(head_only=True), None)
    with pytest.raises(ConfigError, match="unknown"):
        Pretrain(method="mamml")
    for change in ({"inner_learning_rate": 0.0}, {"inner_steps": 0}, {"shots": 0}):
        with pytest.raises(ConfigError, match="must hold"):
            MetaSpec(**change)
    with pytest.raises((BundleError, DataError), match="nowhere"):
        pretrain(machines, experiment, Pretrain(start=tmp_path / "nowhere"), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    chunks = experiment.training.chunks
    for spec, shots in ((dataclasses.replace(chunks, batch=6), 2), (dataclasses.replace(chunks, burn_in=40), 2)):
        with pytest.raises(ConfigError, match="must hold"):
            EpisodeSampler(prepared_machines.train, (2,), spec, shots, 0)
    with pytest.raises(DataError, match="enough for 44 pieces of 40; an episode needs 60"):
        EpisodeSampler(prepared_machines.train, (2,), dataclasses.replace(chunks, batch=60), 30, 0)
    nameless = [dataclasses.replace(part, machine="") for part in prepared_machines.train]
    with pytest.raises(DataError, match="does not say which machine"):
        EpisodeSampler(nameless, (2,), chunks, 2, 0)


def test_episodes_are_of_one_machine_each_and_share_no_tick(prepared_machines, experiment):
    """Inputs are numbered, so that each tick of a batch tells where it comes from."""
    parts = [
        dataclasses.replace(part, inputs=np.column_stack([np.full(part.samples, i), np.arange(part.samples)]))
        for i, part in enumerate(prepared_machines.train)
    ]
    sampler = EpisodeSampler(parts, (2,), experiment.training.chunks, 2, seed=4)
    owners = []
    for batch in sampler.epoch(3):
        for first in range(0, 8, 4):
            group = batch.inputs[first : first + 4]
            ticks = {(int(i), int(t)) for piece in group for i, t in piece}
            assert len(ticks) == 4 * 40
            (owner,) = {parts[i].machine for i, _ in ticks}
            owners.append(owner)
        assert batch.reset.all()
        assert not batch.valid[:, :10].any()
        assert batch.valid[:, 10:].all()
    assert sorted(owners) == sorted(sampler.owned)
    assert len(owners) == 2 * sampler.updates()
    again = [batch.inputs for batch in EpisodeSampler(parts, (2,), experiment.training.chunks, 2, 4).epoch(3)]
    assert all(np.array_equal(one, batch.inputs) for one, batch in zip(again, sampler.epoch(3), strict=True))
    assert stack([(p.inputs, p.targets, p.targets, None) for p in parts[:1]], [True]).strategy_columns is None
