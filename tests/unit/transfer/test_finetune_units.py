"""Methods of a fine-tuning, and models of an evaluation, as units of work: the same numbers as in one process."""

import json
import shutil

import pytest
from noted_progress import NotedProgress

from edp.errors import BundleError
from edp.evaluation import judge
from edp.jobs import Workers
from edp.jobs.workers import UNITS
from edp.networks import running
from edp.storage import read_json
from edp.workflows import train_evaluate
from edp.workflows.train_evaluate import evaluate, read_trained_run
from edp.workflows.transfer import FinetuneRequest, finetune

pytestmark = pytest.mark.processes


def without_times(value):
    """A table without what differs from repeat to repeat."""
    if isinstance(value, dict):
        return {key: without_times(part) for key, part in value.items() if key not in ("seconds", "key", "created")}
    return [without_times(part) for part in value] if isinstance(value, list) else value


def test_methods_trained_apart_are_judged_as_if_trained_here(run, target, small, tmp_path):
    order = FinetuneRequest(spec=small, method="full", baselines=("low_rank", "ridge_arx"))
    there = finetune(run, target, order, tmp_path / "there", workers=Workers(count=2)).to_table()
    here = finetune(run, target, order, tmp_path / "here").to_table()
    assert json.dumps(without_times(there)) == json.dumps(without_times(here))
    with pytest.raises(BundleError):
        finetune(tmp_path / "nothing", target, order, tmp_path / "no", workers=Workers(count=2))
    assert not (tmp_path / "no").exists()


def test_models_run_apart_have_the_scores_of_one_process(run, target, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    names = ("persistence", "ridge_arx", "small_mlp")
    told = NotedProgress()
    for source in (None, target):
        folder = evaluate(tmp_path / "run", source, names, told, workers=Workers(count=2))
        there = read_json(folder / "scores.json")
        (folder / "scores.json").unlink()
        here = read_json(evaluate(tmp_path / "run", source, names) / "scores.json")
        assert without_times(there) == without_times(here)
        assert list(there["models"]) == list(here["models"])
        assert there["key"] == here["key"]
    assert told.stages[-1] == ("model", 4)
    assert not (tmp_path / "run" / UNITS).exists()


def test_a_network_run_in_parts_has_the_scores_of_one_process(run, target, tmp_path, monkeypatch):
    shutil.copytree(run, tmp_path / "run")
    whole = read_json(evaluate(tmp_path / "run", target, ()) / "scores.json")
    monkeypatch.setattr(judge, "PART_TICKS", 100)
    monkeypatch.setattr(judge, "stream_groups", lambda series: running.stream_groups(series, 1))
    told = NotedProgress()
    folder = tmp_path / "run"
    (evaluate(folder, target, ()) / "scores.json").unlink()
    here = read_json(evaluate(folder, target, (), told) / "scores.json")
    assert len(told.notes) > 1
    # Streams side by side and sums in another order differ in their last bits alone.
    assert here["models"]["network"]["overall"] == approx_tree(whole["models"]["network"]["overall"])


def test_all_models_are_scored_on_the_same_ticks(run):
    bundle, _, _, data = read_trained_run(run)
    assert bundle.predictor.spec.window == 10
    bench = judge.ModelBench(bundle.predictor, data, judge.JudgeSpec(baselines=("ridge_arx",), history=30))
    assert bench.skip == 30
    models = [bench.network("", 0.0), bench.baseline("ridge_arx")]
    counts = [[scores["mean"]["count"] for scores in model.entry.overall.values()] for model in models]
    assert counts[0] == counts[1]
    assert judge.ModelBench(bundle.predictor, data, judge.JudgeSpec(baselines=())).skip == 10


def test_scores_from_another_first_tick_are_measured_anew(run, target, tmp_path, monkeypatch):
    shutil.copytree(run, tmp_path / "run")
    first = train_evaluate.first_scored
    monkeypatch.setattr(train_evaluate, "first_scored", lambda *args: first(*args) - 1)
    before = evaluate(tmp_path / "run", target, ()) / "scores.json"
    key = read_json(before)["key"]
    monkeypatch.undo()
    after = read_json(evaluate(tmp_path / "run", target, ()) / "scores.json")
    assert after["key"] != key


def approx_tree(value):
    """A table whose numbers are compared to a millionth."""
    if isinstance(value, dict):
        return {key: approx_tree(part) for key, part in value.items()}
    return pytest.approx(value, rel=1e-6)
