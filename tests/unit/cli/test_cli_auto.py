"""``edp train`` without a preset, and the guard of ``edp evaluate``."""

import json

SETTINGS = ("--set", "task.targets=['CylVels_1']", "--set", "task.horizons=[5]", "--minutes", "0.01")


def test_train_says_what_it_chose_and_why(edp, logs, tmp_path):
    run = tmp_path / "run"
    ended = edp("train", logs, "--out", run, *SETTINGS)
    assert ended.code == 0, ended.err
    assert "is kept" in ended.out
    assert "error on left-out data" in ended.out
    assert "the linear model" in ended.out
    facts = json.loads((run / "auto.json").read_text())
    assert facts["minutes"] == 0.01
    again = edp("train", logs, "--out", run, *SETTINGS, "--json")
    assert again.json["sentence"] == facts["sentence"]


def test_settings_of_a_network_take_the_preset_standard(edp, logs, tmp_path, small):
    run = tmp_path / "run"
    assert small[:2] == ["--preset", "quick"]
    assert edp("train", logs, "--out", run, *small[2:]).code == 0
    assert "units = 6" in (run / "config.toml").read_text()
    assert not (run / "auto.json").exists()


def test_minutes_are_of_the_preset_auto_alone(edp, logs, tmp_path):
    ended = edp("train", logs, "--out", tmp_path / "run", "--preset", "quick", "--minutes", "3")
    assert ended.code == 1
    assert "only the preset auto has a budget" in ended.err
    assert not (tmp_path / "run").exists()


def test_a_network_that_loses_says_so_first_and_by_its_exit_code(edp, trained):
    few = ("evaluate", trained, "--baselines", "persistence")
    edp(*few)
    file = trained / "scores.json"
    scores = json.loads(file.read_text())
    for model, factor in (("network", 2.0), ("persistence", 1.0)):
        for targets in scores["models"][model]["overall"].values():
            for metrics in targets.values():
                metrics["rmse"] = factor
    file.write_text(json.dumps(scores))
    lost = edp(*few)
    assert lost.code == 6
    assert lost.out.startswith("On the held-out recordings Persistence has 50.0 % less error")
    assert edp(*few, "--json").json["beaten_by"] == "Persistence"
    for targets in scores["models"]["network"]["overall"].values():
        for metrics in targets.values():
            metrics["rmse"] = 0.5
    file.write_text(json.dumps(scores))
    won = edp(*few)
    assert won.code == 0
    assert "less error than the network" not in won.out
