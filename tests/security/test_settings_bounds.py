"""Settings without sense: every number of every spec is accepted and then works, or is refused by its name, quickly."""

import dataclasses
import math
import typing
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from edp.config.experiment import SETTINGS, Experiment, FeatureSettings, TaskSettings, build, load_experiment
from edp.data.chunks import ChunkSpec
from edp.data.screening.spec import ForestSpec, ScreeningSpec
from edp.data.series import Series
from edp.errors import ConfigError, EdpError
from edp.evaluation.channel_importance import ChannelImportanceSpec
from edp.evaluation.controller import Budget
from edp.evaluation.judge import JudgeSpec
from edp.ir.rls import AdaptationSpec
from edp.networks.losses import AdaptiveWeights
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.networks.size import size_at_most
from edp.settings.bounds import MAX_SEED, Bound, shown
from edp.signals import Kind
from edp.training.bundle import blank_scaler
from edp.training.compression.distillation import DistillationSpec, SoftmaxDivergence
from edp.training.fit import Loop
from edp.training.pretraining.spec import MetaSpec
from edp.training.spec import TrainingSpec
from edp.training.transfer.both_domains import BothSpec
from edp.training.transfer.spec import FinetuneSpec
from edp.workflows.feature_selection.trials import TrialSpec
from edp.workflows.search.runner import Resources
from edp.workflows.search.settings import SearchSpec
from edp.workflows.search.study import SamplerSpec

TREE = [FeatureSettings, TaskSettings, ModelSpec, TrainingSpec, ChunkSpec, AdaptiveWeights, JudgeSpec]
OTHERS = [
    ScreeningSpec,
    ForestSpec,
    SearchSpec,
    SamplerSpec,
    FinetuneSpec,
    MetaSpec,
    Budget,
    ChannelImportanceSpec,
    TrialSpec,
    BothSpec,
    DistillationSpec,
    SoftmaxDivergence,
    AdaptationSpec,
    Resources,
]
REGISTERED = sorted(
    {cls for registry in SETTINGS.parts.values() for cls in registry.values()}, key=lambda cls: cls.__qualname__
)
SPECS = [*TREE, *OTHERS, *REGISTERED]
BASE = {FeatureSettings: {"channels": ["a"]}}
"""What a spec cannot do without."""
EXTREMES = [
    -(10**26), -100_000, -5, -1, 0, 1, 10**5, 10**8, 10**9, 10**11, 2**32, 2**63, 2**64, 10**26, 10**6000,
    math.nan, math.inf, -math.inf, 1e-320, 1e38, 1e300, -1e300, -0.5, 0.5,
]  # fmt: skip


def numeric(cls):
    """Fields of whole or real numbers, alone or in a list: name, and whether it is a list."""
    hints = typing.get_type_hints(cls)
    found = []
    for entry in dataclasses.fields(cls):
        hint = hints[entry.name]
        inner = typing.get_args(hint)
        if hint in (int, float) or (
            set(inner) & {int, float}
            and typing.get_origin(hint) is not tuple
            and dict not in (typing.get_origin(hint),)
        ):
            found.append((entry.name, False))
        elif typing.get_origin(hint) is tuple and inner[0] in (int, float):
            found.append((entry.name, True))
    return found


FIELDS = [(cls, name, listed) for cls in SPECS for name, listed in numeric(cls)]


def attempt(cls, name, listed, value):
    """The spec with this value, or None where it is refused by name; nothing else may happen."""
    try:
        return build(cls, BASE.get(cls, {}) | {name: [value] if listed else value}, "here")
    except ConfigError as error:
        text = str(error)
        assert name.removesuffix("s") in text, text
        assert len(text) < 2000
        return None


def test_the_fields_are_all_there():
    assert len(FIELDS) > 120
    names = {(cls.__name__, name) for cls, name, _ in FIELDS}
    assert {
        ("JudgeSpec", "warmup_samples"),
        ("TrainingSpec", "seed"),
        ("Plateau", "threshold"),
        ("HybridSpec", "units"),
    } <= names


@pytest.mark.parametrize("cls", SPECS, ids=lambda cls: cls.__qualname__)
def test_extreme_numbers_are_accepted_or_refused_by_name(cls):
    for name, listed in numeric(cls):
        for value in EXTREMES:
            made = attempt(cls, name, listed, value)
            if made is not None:
                assert isinstance(value, int) or math.isfinite(value), f"{name} = {value} was accepted"
        for value in (True, False, [[1]], {"a": 1}, "x"):
            assert attempt(cls, name, listed, value) is None, f"{name} = {value!r} was accepted"


@settings(max_examples=300, deadline=None)
@given(
    place=st.sampled_from(FIELDS),
    value=st.one_of(st.integers(), st.integers(-(10**30), 10**30), st.floats(), st.sampled_from(EXTREMES)),
)
def test_any_number_is_accepted_or_refused_by_name(place, value):
    cls, name, listed = place
    made = attempt(cls, name, listed, value)
    if made is not None:
        got = getattr(made, name)
        assert math.isfinite(got[0] if listed else got)


PARTS = [
    (place, kind, name, listed)
    for place in ("backbone", "head", "activation", "output", "blocks")
    for kind, cls in SETTINGS.parts[place].items()
    for name, listed in numeric(cls)
] + [("model", "", "window", False), ("task", "", "horizons", True)]


@pytest.mark.parametrize(("place", "kind", "name", "listed"), PARTS)
def test_networks_of_extreme_sizes_are_built_or_refused_before_they_take_memory(place, kind, name, listed):
    for value in (1, 3, 4096, 10**5, 65_536, 10**9, 10**11):
        held = [value, value] if name == "first_dilations" else [value] if listed else value
        part = {"kind": kind, name: held}
        model = {place: [part] if place == "blocks" else part} if kind else ({name: held} if place == "model" else {})
        task = {name: held} if place == "task" else {}
        try:
            experiment = build(Experiment, {"model": {"blocks": []} | model, "task": task}, "here")
            resolved = experiment.task.resolve(100.0)
            net = build_model(resolved, experiment.model, blank_scaler(resolved), 0)
        except ConfigError:
            continue
        assert sum(parameter.numel() for parameter in net.parameters()) <= 50_000_000


def test_the_bound_of_a_network_is_never_below_its_size(structure, predictor_of):
    predictor = predictor_of(structure)
    parameters, state = size_at_most(predictor.spec, predictor.task)
    assert sum(parameter.numel() for parameter in predictor.parameters()) <= parameters
    assert state > 0


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("evaluation.warmup_samples=-5", r"evaluation: warmup_samples = -5; integers, 0 <= warmup_samples"),
        ("evaluation.warmup_samples=-100000", r"warmup_samples = -100000"),
        ("model.window=true", r"model\.window = True: true and false are no numbers"),
        ("model.window=1000000000", r"window = 1000000000"),
        ("model.backbone.units=100000", r"units = 100000; integers, 1 <= units <= 4,096"),
        ("model.backbone.kernel=100000000", r"kernel = 100000000"),
        (f"model.backbone.channels={[4] * 300}", r"channels has 300 entries; 1 to 16 must hold"),
        ("training.chunks.length=100000000000", r"length = 100000000000"),
        ("training.seed=-1", r"seed = -1"),
        ("training.seed=100000000000000000000000000", r"seed = 1"),
        ("split.seed=-1", r"seed = -1"),
        ("training.optimizer.learning_rate=inf", r"learning_rate"),
        ("training.optimizer.learning_rate=nan", r"learning_rate"),
        ("training.optimizer.learning_rate=-1.0", r"learning_rate = -1\.0"),
        ("training.optimizer.beta1=1.0", r"beta1 = 1\.0"),
        ("split.test_fraction=nan", r"split\.test_fraction"),
        ("split.test_fraction=5", r"test_fraction = 5"),
        (f"task.horizons={list(range(1, 5001))}", r"horizons has 5,000 entries; 1 to 1,000 must hold"),
        ("task.horizons=[1000000000]", r"horizons = \[1000000000\]"),
        ("task.targets=['CylVels_1','CylVels_1']", r"targets names CylVels_1 twice"),
        ("model.backbone.kind=5", r"kind = 5"),
        ("model.backbone.kind=['a']", r"kind = \['a'\]"),
    ],
)
def test_settings_from_the_list_are_refused(override, words):
    with pytest.raises(ConfigError, match=words):
        load_experiment(overrides=[override])


def test_all_problems_are_still_told_at_once_and_long_ones_are_cut():
    with pytest.raises(ConfigError) as caught:
        load_experiment(
            overrides=["evaluation.warmup_samples=-5", "training.seed=-1", "model.window=0", "x" * 5000 + "=1"]
        )
    text = str(caught.value)
    for part in ("4 problems", "evaluation: warmup_samples = -5", "seed = -1", "window = 0", "unknown key 'xxx"):
        assert part in text
    assert len(text) < 1000
    with pytest.raises(ConfigError, match="and 950 more"):
        build(Experiment, {f"key{i}": 1 for i in range(1000)}, "here")


@pytest.mark.parametrize("digits", [300, 5000, 100_000])
def test_numbers_of_thousands_of_digits_are_told_by_their_length(digits):
    with pytest.raises(EdpError) as caught:
        build(Experiment, {"training": {"seed": 10**digits}}, "here")
    assert "seed" in str(caught.value)
    assert f"a number of about {digits:,} digits" in shown(10**digits) or digits > 10_000
    assert len(str(caught.value)) < 500


@given(st.one_of(st.integers(), st.text(), st.lists(st.integers()), st.dictionaries(st.text(), st.floats())))
def test_values_are_repeated_in_a_line_at_most(value):
    assert len(shown(value)) < 400


def test_bounds_know_numbers():
    bound = Bound(0, 2, above=True)
    assert [bound.holds(v) for v in (0, 1, 2, 2.5, True, "1", None, math.nan, np.float64(1.5))] == [
        False, True, True, False, False, False, False, False, True,
    ]  # fmt: skip
    assert Bound(0, MAX_SEED, integer=True).holds(np.int64(5))
    assert not Bound(0, MAX_SEED, integer=True).holds(5.0)


def prepared(task, ticks=400):
    rng = np.random.default_rng(0)

    def series(name):
        inputs = rng.standard_normal((ticks, len(task.inputs)), dtype=np.float32)
        return Series(name, inputs, rng.standard_normal((ticks, len(task.targets)), dtype=np.float32))

    return SimpleNamespace(
        task=task,
        train=[series("a")],
        validation=[series("b")],
        test=[series("c")],
        target_kinds=(Kind.VELOCITY,) * len(task.targets),
        scaler=lambda: blank_scaler(task),
    )


@pytest.mark.parametrize(
    "changes",
    [
        ["training.chunks.batch=1000000"],
        ["training.chunks.length=65536", "training.chunks.batch=16384"],
        ["training.chunks.regime=window", "training.chunks.length=4096", "training.chunks.batch=100000"],
        ["model.window=65536", "training.chunks.batch=4096"],
    ],
)
def test_memory_that_a_training_needs_is_refused_before_it_is_taken(changes, monkeypatch):
    monkeypatch.setattr("edp.storage.memory.free_bytes", lambda: 20 * 10**9)
    experiment = load_experiment(preset="quick", overrides=changes)
    task = experiment.task.resolve(100.0)
    taken = []
    monkeypatch.setattr(Predictor, "initial_state", _watched(Predictor.initial_state, taken))
    with pytest.raises(
        ConfigError, match=r"training\.chunks\.batch = .* would take .* [GT]B of memory, 20 GB are free"
    ):
        Loop(prepared(task), experiment.model, experiment.training, None)
    assert max(taken, default=1) == 1  # only one stream was tried


def _watched(method, taken):
    def initial_state(self, batch, like):
        taken.append(batch)
        return method(self, batch, like)

    return initial_state


def test_the_memory_of_a_training_leaves_its_random_numbers_alone():
    experiment = load_experiment(preset="small", overrides=["training.chunks.burn_in=10", "training.chunks.length=64"])
    task = experiment.task.resolve(100.0)
    torch.manual_seed(3)
    before = torch.get_rng_state()
    Loop(prepared(task), experiment.model, experiment.training, None)
    assert torch.equal(torch.get_rng_state(), before)


def test_a_judgement_of_too_many_predictions_is_refused(monkeypatch):
    from edp.evaluation.judge import judge

    monkeypatch.setattr("edp.storage.memory.free_bytes", lambda: 10_000_000)
    experiment = load_experiment(preset="small", overrides=[f"task.horizons={list(range(1, 1001))}"])
    task = experiment.task.resolve(100.0)
    net = build_model(task, experiment.model, blank_scaler(task), 0)
    with pytest.raises(ConfigError, match=r"evaluation: 2,000 ticks of 1,000 horizon\(s\)"):
        judge(net, prepared(task, 2000), experiment.evaluation, "net")


def test_a_regression_on_too_long_a_history_is_refused(monkeypatch):
    from edp.data.ridge_moments import moments_of, standard_of
    from edp.evaluation.judge import baseline_task

    monkeypatch.setattr("edp.storage.memory.free_bytes", lambda: 100_000_000)
    task = load_experiment(preset="small").task.resolve(100.0)
    data = prepared(task, 5000)
    lagged = baseline_task(data, JudgeSpec(history=1000))
    with pytest.raises(ConfigError, match=r"a regression on 1,000 ticks of 24 inputs would take"):
        moments_of(data.train, lagged, standard_of(data.train, np.zeros(3)))
