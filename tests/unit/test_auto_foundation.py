"""The preset auto with a pretrained network among its candidates: trained on, judged like the others, or refused."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.errors import ConfigError, DataError
from edp.workflows.auto import load_auto, train_auto
from edp.workflows.train_evaluate import DataSource, evaluate, read_trained_run, train

pytestmark = pytest.mark.processes

TASK = ["task.features='all'", "task.targets=['y']", "task.horizons=[4]", "split.kind='time'"]
SMALL = [
    *("model.backbone={kind='hybrid',channels=[8],kernel=3,units=8}", "model.window=20"),
    *("training.epochs=3", "training.updates=40", "training.chunks.length=32", "training.chunks.batch=8"),
    *("training.chunks.burn_in=20", "training.threads=1"),
]
AUTO = [*TASK, "auto.time_budget_min=0.002", "evaluation.baselines=['persistence']", "evaluation.history=20"]


def logs(folder: Path, gain: float, ticks: int = 3000, names: tuple[str, str] = ("u", "y"), rate: float = 50.0):
    """A saturated plant of some gain as a CSV with a map."""
    rng = np.random.default_rng(round(100 * gain))
    u = np.repeat(rng.uniform(-2, 2, ticks // 10 + 1), 10)[:ticks]
    y = np.zeros(ticks)
    for tick in range(1, ticks):
        y[tick] = 0.9 * y[tick - 1] + 0.3 * np.tanh(gain * u[tick - 1]) + 0.01 * rng.normal()
    folder.mkdir(parents=True)
    table = np.column_stack([np.arange(ticks) / rate, u, y])
    np.savetxt(folder / "log.csv", table, "%.6f", ",", header=",".join(("time", *names)), comments="")
    entries = [f'[channels.{name}]\ncolumn = "{name}"\nkind = "generic"' for name in names]
    (folder / "map.toml").write_text('time = "time"\n' + "\n".join(entries))
    return DataSource.from_path(folder / "log.csv", folder / "map.toml")


@pytest.fixture(scope="module")
def pretrained(tmp_path_factory):
    """A network of a plant of gain 2."""
    folder = tmp_path_factory.mktemp("pretrained")
    train(logs(folder / "logs", 2.0), load_experiment(None, "small", [*TASK, *SMALL]), folder / "run")
    return folder / "run"


def test_it_is_trained_on_and_judged_in_the_units_of_the_data(pretrained, tmp_path):
    source = logs(tmp_path / "logs", 1.5)
    changes = [*AUTO, f"auto.foundation='{pretrained}'", "auto.candidates=['linear', 'foundation']"]
    facts = train_auto(source, load_auto(None, changes), tmp_path / "run").choice.to_table()
    assert set(facts["candidates"]) == {"linear", "foundation"}
    promised = facts["candidates"]["foundation"]["promise"]["4"]["y"]
    # A scale of the source in place of the data's would put the promise far from what is measured.
    evaluate(tmp_path / "run")
    scores = json.loads((tmp_path / "run" / "scores.json").read_text())["models"]
    rival = scores["persistence"]["overall"]["4"]["y"]["rmse"]
    assert facts["persistence"]["4"]["y"] == pytest.approx(rival, rel=0.3)
    assert promised < facts["persistence"]["4"]["y"]


def test_alone_it_is_kept_as_a_run_like_any_other(pretrained, tmp_path):
    source = logs(tmp_path / "logs", 1.5)
    changes = [*AUTO, f"auto.foundation='{pretrained}'", "auto.candidates=['foundation']"]
    found = train_auto(source, load_auto(None, changes), tmp_path / "run")
    assert found.choice.to_table()["chosen"] == "foundation"
    bundle, experiment, _, _ = read_trained_run(tmp_path / "run")
    assert experiment.model == bundle.predictor.spec
    assert experiment.training.ensemble is None
    assert train_auto(source, load_auto(None, changes), tmp_path / "run").choice.to_table() == found.choice.to_table()


@pytest.mark.parametrize(
    ("settings", "shape", "message"),
    [
        (["task.horizons=[2]"], {}, r"horizons \(4,\), the settings \(2,\)"),
        (["task.mode='absolute'"], {}, "mode delta, the settings absolute"),
        ([], {"names": ("v", "y")}, "lacks u"),
        ([], {"rate": 20.0}, "runs at 50 Hz"),
        ([], {"ticks": 120}, "too short|longer|ticks"),
    ],
)
def test_what_does_not_fit_is_one_error_and_leaves_nothing(pretrained, tmp_path, settings, shape, message):
    source = logs(tmp_path / "logs", 1.5, **shape)
    changes = [*AUTO, f"auto.foundation='{pretrained}'", *settings]
    with pytest.raises((ConfigError, DataError), match=message):
        train_auto(source, load_auto(None, changes), tmp_path / "run")
    assert not (tmp_path / "run" / "run.json").exists()


def test_a_committee_is_refused_as_a_start(tmp_path):
    source = logs(tmp_path / "logs", 1.5)
    train_auto(source, load_auto(None, [*AUTO, "auto.candidates=['linear']"]), tmp_path / "first")
    with pytest.raises(ConfigError, match="is a committee"):
        train_auto(source, load_auto(None, [*AUTO, f"auto.foundation='{tmp_path / 'first'}'"]), tmp_path / "run")


@pytest.mark.parametrize("settings", [["auto.candidates=['foundation']"], ["auto.foundation='r'"]])
def test_candidate_and_run_go_together(settings):
    with pytest.raises(ConfigError, match="go together"):
        load_auto(None, [*AUTO, "auto.candidates=['linear']", *settings])
