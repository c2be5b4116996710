"""``edp compress estimate`` prints the counts of the thesis for its settings (Tables B.1, 4.8, 4.9)."""

import dataclasses
import json
import sys
from pathlib import Path

import pytest

from edp.cli import app
from edp.cli.console import run_app
from edp.config.experiment import load_experiment
from edp.networks.losses import TERMS
from edp.networks.predictor import ModelSpec, describe

FOLDER = Path(__file__).parents[2] / "examples" / "thesis"
# Parameters as stored; MACs of a window in M to three digits as printed; MACs per tick in k to four digits.
PRINTED = {
    "table_b1": (1_376_775, "62.88", "1379"),
    "table_b1_training": (1_376_775, "62.88", "1379"),
    "k10_teacher": (1_197_319, "45.198", "1206"),
    "k10_student_u64": (84_292, "3.257", "86.6"),
    "k10_student_u32": (24_228, "0.958", "25.4"),
    "k1_teacher_p4": (677_572, "31.281", "680.5"),
    "k1_student_u64": (181_956, "8.409", "183.6"),
    "k1_student_u32": (53_604, "2.486", "54.4"),
    # Their multiply-accumulates are our own count: the printed ones take recurrent layer and bridge once, not 50 times.
    "k1_teacher_p5": (703_527, "33.23", "710.4"),
    "k1_student_p5_u64": (213_972, "10.37", "220.4"),
    "k1_student_p5_u32": (61_996, "3.06", "65.2"),
}
FOLDED = {
    "k10_teacher": 1_196_804,
    "k10_student_u64": 84_164,
    "k1_teacher_p4": 676_676,
    "k1_student_u64": 181_572,
    "k1_teacher_p5": 702_628,
    "k1_student_p5_u64": 213_588,
}


def test_every_file_is_held_to_the_table():
    assert sorted(path.stem for path in FOLDER.glob("*.toml")) == sorted(PRINTED)


@pytest.mark.parametrize("name", PRINTED)
def test_counts(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["edp", "compress", "estimate", str(FOLDER / f"{name}.toml"), "--json"])
    assert run_app(app) == 0
    counts = json.loads(capsys.readouterr().out)
    parameters, window, tick = PRINTED[name]
    assert counts["parameters"] == parameters
    assert f"{counts['macs_window'] / 1e6:.{len(window.partition('.')[2])}f}" == window
    assert f"{counts['macs_tick'] / 1e3:.{len(tick.partition('.')[2])}f}" == tick
    if name in FOLDED:
        assert counts["parameters_folded"] == FOLDED[name]
    assert counts["window"] == 50


def test_the_training_of_table_b1_is_what_is_printed_there():
    made = load_experiment(FOLDER / "table_b1_training.toml", "thesis")
    preset, training = load_experiment(FOLDER / "table_b1.toml", "thesis"), made.training
    assert dataclasses.replace(made.model.backbone, dropout=preset.model.backbone.dropout) == preset.model.backbone
    assert (made.model.head, made.model.activation, made.model.blocks) == (
        *(preset.model.head, preset.model.activation, preset.model.blocks),
    )
    assert [(TERMS.name_of(term), term.weight) for term in training.terms] == [
        ("smoothness", 0.05),
        ("derivative", 0.1),
    ]
    assert training.augmentations[0].std == 0.02
    assert (training.weight_power, training.clip_norm, training.patience, training.epochs) == (2.0, 1.0, 8, 25)
    assert (training.loss.delta, training.optimizer.learning_rate, training.optimizer.weight_decay) == (1.5, 3e-4, 5e-4)
    assert (training.chunks.regime, training.chunks.length, training.chunks.batch) == ("window", 50, 32)
    assert 3e-4 * training.schedule.min_lr_ratio == pytest.approx(1e-7, rel=0.02)


def test_a_label_names_what_is_not_plain():
    b1 = load_experiment(FOLDER / "table_b1.toml", "thesis").model
    assert describe(b1) == "hybrid + multi_scale_tcn + cylinder_gate + stanh activation"
    assert describe(ModelSpec()) == "hybrid"


def test_a_budget_file_is_held_against_and_an_impossible_one_is_refused(monkeypatch, capsys, tmp_path):
    budget = FOLDER.parent / "budgets" / "small_controller.toml"
    settings = str(FOLDER / "k10_student_u32.toml")
    monkeypatch.setattr(sys, "argv", ["edp", "compress", "estimate", settings, "--budget", str(budget), "--json"])
    assert run_app(app) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["budget"]["cycles"] == 360_000
    fits = {row["what"]: row["fits"] for row in facts["verdict"]}
    assert fits["cycles per tick, w8a16"]
    assert not fits["cycles per prediction, windowed"]

    (tmp_path / "none.toml").write_text("cycles = 100")
    monkeypatch.setattr(sys, "argv", ["edp", "compress", "estimate", settings, "--budget", str(tmp_path / "none.toml")])
    assert run_app(app) == 1
    assert "cycles = 100 can be met by no network" in " ".join(capsys.readouterr().err.split())
