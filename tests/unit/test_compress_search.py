"""The search for the best network that a controller can run: what it makes, chooses, records and refuses."""

import csv
import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from browser import browser as browser
from browser import check_page
from noted_progress import NotedProgress
from typer.testing import CliRunner

from edp.cli import app
from edp.config.experiment import load_experiment
from edp.errors import ConfigError, StorageError
from edp.evaluation.compression import read_compression
from edp.evaluation.controller import Budget
from edp.export.c.sizes import constant_bytes
from edp.ir.w8a16.quantise import outline
from edp.networks.backbones import GruSpec, HybridSpec, LstmSpec, TcnSpec
from edp.networks.blocks import AttentionBridge, TemporalDifference
from edp.networks.cells import LayerNormLstmCell
from edp.networks.predictor import build_model
from edp.report import write_compression_page
from edp.storage import read_json
from edp.training import load_bundle
from edp.training.bundle import blank_scaler
from edp.workflows.compression import (
    CompressionSearchRequest,
    CompressionSearchSpec,
    resource_usage,
    search,
    searching,
)
from edp.workflows.compression.planning import make_plan
from edp.workflows.train_evaluate import train

pytestmark = pytest.mark.long

SETTINGS = (
    'task.features={name="levers", channels=["speed", "lever"]}',
    'task.targets=["speed"]',
    "task.horizons=[1, 3]",
    "training.epochs=2",
    "training.updates=4",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[16],kernel=2,units=16}',
    "model.head.hidden=8",
    "model.blocks=[]",
    "model.window=10",
    'evaluation.baselines=["persistence"]',
)


@pytest.fixture(scope="module")
def run(lever_sessions, tmp_path_factory):
    folder = tmp_path_factory.mktemp("teacher") / "run"
    train(lever_sessions, load_experiment(preset="quick", overrides=SETTINGS), folder)
    return folder


@pytest.fixture(scope="module")
def tight(run):
    """Half of what the teacher takes in integers."""
    need = resource_usage(load_bundle(run).predictor, "w8a16", Budget())
    return Budget(name="tight", cycles=need.cycles[2] // 2, parameter_bytes=need.parameter_bytes // 2)


def asked(changes=(), **values):
    return CompressionSearchRequest(spec=CompressionSearchSpec(**values), changes=changes)


@pytest.fixture(scope="module")
def done(run, tight, tmp_path_factory):
    folder = tmp_path_factory.mktemp("search") / "out"
    return folder, search(run, asked(budget=tight, formats=("float32", "w8a16")), folder)


def test_the_best_that_fits_is_chosen_on_validation_and_judged_once(done, tight):
    folder, found = done
    best = found.best
    assert best is not None
    assert best.fits
    assert best.error == min(row.error for row in found.rows if row.fits)
    assert best.resource_usage.cycles[2] <= tight.cycles
    for place, row in enumerate(found.rows):
        point = (row.error, row.resource_usage.cycles[2], row.resource_usage.parameter_bytes)
        others = [(r.error, r.resource_usage.cycles[2], r.resource_usage.parameter_bytes) for r in found.rows]
        beaten = any(all(a <= b for a, b in zip(other, point)) and other != point for other in others)
        assert (place in found.front) != beaten
    assert {row.recipe for row in found.rows} >= {"teacher", "distilled", "pruned and distilled"}
    assert any(row.recipe.endswith("trained on rounded") for row in found.rows)
    held = read_json(folder / "compression.json")
    assert len(held["held_out_test"]["openings"]) == 1
    assert set(held["held_out_test"]["scores"]) == {"teacher", "chosen"}
    assert held["held_out_test"]["seen_before"] is False
    assert load_bundle(best.run).predictor.spec.backbone.units < 16


def test_the_same_call_trains_and_opens_nothing_again(run, tight, done, monkeypatch):
    folder, found = done
    monkeypatch.setattr(searching, "train", None)
    again = search(run, asked(budget=tight, formats=("float32", "w8a16")), folder)
    assert [row.name for row in again.rows] == [row.name for row in found.rows]
    assert [row.error for row in again.rows] == [row.error for row in found.rows]
    assert len(again.held_out_test.openings) == 1


@pytest.mark.slow
def test_a_stopped_search_goes_on_to_the_same_result(run, tight, done, tmp_path):
    class Pulled(Exception):
        pass

    trained = []

    def pull(done, **values):
        if not values:
            trained.append(done)
        elif trained and "validation_mae" in values:
            raise Pulled

    spec = asked(budget=tight, formats=("float32", "w8a16"))
    with pytest.raises(Pulled):
        search(run, spec, tmp_path / "out", progress=NotedProgress(pull))
    found = search(run, spec, tmp_path / "out")
    assert [row.error for row in found.rows] == [row.error for row in done[1].rows]


def test_another_choice_needs_a_word_and_is_recorded(run, tight, done, tmp_path):
    folder = shutil.copytree(done[0], tmp_path / "out")
    other = asked(budget=tight, units=(2,), formats=("float32",))
    with pytest.raises(ConfigError, match="was opened on"):
        search(run, other, folder)
    looked = search(run, replace(other, again=True), folder)
    assert looked.best != done[1].best
    assert len(looked.held_out_test.openings) == 2


def test_a_budget_that_nobody_can_meet_is_refused_with_the_nearest(run, tmp_path):
    with pytest.raises(
        ConfigError, match=r"cycles = 100 can be met by no width .* single unit in INT8, with cycles = \d"
    ):
        search(run, asked(budget=Budget(name="none", cycles=100)), tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("spec", "reason"),
    [
        (asked(budget=Budget(), units=(17,)), "1 <= units <= 16"),
        (asked(("model.window=20",)), "those of its teacher"),
    ],
)
def test_what_cannot_be_is_refused(run, tmp_path, spec, reason):
    with pytest.raises(ConfigError, match=reason):
        search(run, spec, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_what_has_no_form_in_whole_numbers_is_left_out_with_the_reason(tiny, tiny_model):
    backbone = replace(tiny_model.backbone, cell=LayerNormLstmCell())
    teacher = build_model(tiny.task, replace(tiny_model, backbone=backbone), blank_scaler(tiny.task), seed=0)
    plan = make_plan(teacher, Budget())
    assert "w8a16" not in plan.formats
    assert not plan.rounds
    assert {order.name[0] for orders in plan.orders.values() for order in orders} == {"u"}
    assert any(note.startswith("pruning: no rule") for note in plan.notes)
    assert any("LayerNormLstm" in note for note in plan.notes)


def test_widths_reach_from_the_widest_that_fits_to_a_quarter_of_it(run):
    teacher = load_bundle(run).predictor
    plan = make_plan(teacher, Budget(), formats=("float32",))
    assert tuple(plan.orders) == (8, 4)
    need = resource_usage(teacher, "float32", Budget())
    narrow = make_plan(teacher, Budget(cycles=need.cycles[2] - 1), formats=("float32",))
    assert tuple(narrow.orders) == (12, 4, 2)


def test_recipes_can_be_left_out(run):
    teacher = load_bundle(run).predictor
    plan = make_plan(teacher, Budget(), units=(4,), recipes=("pruned",))
    assert [order.name for orders in plan.orders.values() for order in orders] == ["p4"]
    for recipes, message in ((("cut",), "recipes = cut; some of distilled, pruned"), ((), "recipes = none; some of")):
        with pytest.raises(ConfigError, match=message):
            make_plan(teacher, Budget(), recipes=recipes)


def test_the_widest_network_fits_with_all_of_its_constants(run):
    """A budget of one byte less than a width's constants takes the next narrower one."""
    teacher = load_bundle(run).predictor
    need = resource_usage(teacher, "w8a16", Budget())
    graph = outline(teacher.graph())
    assert need.parameter_bytes == constant_bytes(graph) > sum(values.nbytes for _, _, values in graph.tensors())
    fits = make_plan(teacher, Budget(parameter_bytes=need.parameter_bytes), formats=("w8a16",))
    short = make_plan(teacher, Budget(parameter_bytes=need.parameter_bytes - 1), formats=("w8a16",))
    assert max(short.orders) > max(fits.orders)  # the teacher itself is no order


@pytest.mark.processes
def test_the_page_in_a_browser(done, browser):
    folder, _ = done
    check_page(browser, write_compression_page(folder, pictures=False), "compression")


def test_report_tables_and_pictures(done):
    folder, found = done
    page = write_compression_page(folder)
    text = page.read_text()
    assert "http://" not in re.sub(r"<script>.*?</script>", "", text, flags=re.DOTALL)
    assert found.best.name in text
    for k in (1, 3):
        rows = list(csv.reader((folder / "tables" / f"k{k}.csv").read_text().splitlines()))
        assert rows[0][:3] == ["Variant", "Made", "MAE [mm/s]"]
        assert len(rows) == 1 + len(read_json(folder / "compression.json")["rows"])
        assert (folder / "pictures" / f"profile_k{k}.svg").is_file()
    with pytest.raises(StorageError, match=r"holds no compression\.json"):
        read_compression(folder / "runs")


def test_the_command_prints_the_table_and_the_choice(run, tmp_path):
    (tmp_path / "budget.toml").write_text("cycles = 60_000\n")
    arguments = ["compress", str(run), "--budget", str(tmp_path / "budget.toml"), "--out", str(tmp_path / "out")]
    arguments += ["--set", "compress.units=[4]", "--set", 'compress.formats=["w8a16"]']
    arguments += ["--set", "training.epochs=1"]
    shown = CliRunner().invoke(app, arguments)
    assert shown.exit_code == 0, shown.output
    assert "Variant" in shown.output
    assert "fits “budget”" in shown.output
    facts = json.loads(CliRunner().invoke(app, [*arguments, "--json"]).stdout)
    assert facts["rows"][facts["chosen"]]["fits"]
    assert np.isfinite(facts["held_out_test"]["error"])


@pytest.mark.parametrize(
    ("backbone", "blocks"),
    [
        (LstmSpec(units=12), ()),
        (GruSpec(units=12), ()),
        (TcnSpec(channels=(12, 8), kernel=3), ()),
        (HybridSpec(channels=(16, 16), kernel=2, units=16), (AttentionBridge(heads=4), TemporalDifference())),
    ],
)
def test_every_kind_of_network_has_a_plan(tiny, tiny_model, backbone, blocks):
    """Widths that cannot be built, as of a bridge whose heads do not divide the channels, are left out."""
    model = replace(tiny_model, backbone=backbone, blocks=blocks)
    teacher = build_model(tiny.task, model, blank_scaler(tiny.task), seed=0)
    plan = make_plan(teacher, Budget())
    assert plan.orders
    for ways in plan.orders.values():
        for order in ways:
            build_model(tiny.task, order.model(model), blank_scaler(tiny.task), seed=0)


def test_a_width_that_cannot_be_built_is_refused(tiny, tiny_model):
    backbone = HybridSpec(channels=(16,), kernel=2, units=16)
    model = replace(tiny_model, backbone=backbone, blocks=(AttentionBridge(heads=4),))
    teacher = build_model(tiny.task, model, blank_scaler(tiny.task), seed=0)
    with pytest.raises(ConfigError, match="heads = 4 do not divide"):
        make_plan(teacher, Budget(), units=(6,))


@pytest.mark.parametrize(
    ("part", "value", "message"),
    [
        ("chosen", 99, "got indices"),
        ("front", ["first"], r"front = \['first'\]"),
        ("budget", {"cycles": "many"}, r"budget.cycles = 'many': a text is no number"),
        ("rows", [{"name": "u4"}], r"'rows\[0\].recipe' is missing"),
        ("notes", 3, "notes = 3: a list must hold"),
        ("verdict", "good", "unknown key 'verdict'"),
    ],
)
def test_a_result_that_was_changed_by_hand_is_one_message(done, tmp_path, part, value, message):
    content = read_json(done[0] / "compression.json") | {part: value}
    (tmp_path / "compression.json").write_text(json.dumps(content))
    with pytest.raises(StorageError, match=message) as told:
        read_compression(tmp_path)
    assert "run edp compress search again" in str(told.value)
