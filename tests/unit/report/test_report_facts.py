import json
from dataclasses import replace

import pytest

from edp.errors import DataError, StorageError
from edp.evaluation.guard import network_verdict
from edp.report.run.facts import (
    NETWORK,
    comparison_rows,
    headline,
    horizon_text,
    read_facts,
    recordings_won,
    spread_text,
    verdict_lines,
)
from edp.report.run.outputs import describe_evaluation
from edp.report.run.tables import comparison_tables, key_figures
from edp.settings.provenance import DataOrigin, DataPart, Provenance
from edp.storage import write_json
from edp.wording import decimals_for, duration, listed, number, percent, unbroken


def edit_scores(folder, change):
    scores = json.loads((folder / "scores.json").read_text())
    change(scores)
    write_json(folder / "scores.json", scores)


def mae(value):
    return {"mean": {"mae": value, "rmse": value, "r2": None, "p95": value, "p99": value, "bias": 0.0}}


def test_headline_states_the_scores_of_the_longest_horizon(run_folder):
    def change(scores):
        scores["models"] = {
            "persistence": {"label": "persistence", "overall": {"10": mae(21.41)}},
            "network": {"label": "TCN", "overall": {"10": mae(7.08), "1": mae(0.2)}},
            "ridge_arx": {"label": "ridge", "overall": {"10": mae(13.0)}},
        }

    edit_scores(run_folder, change)
    said = headline(read_facts(run_folder))
    assert said == "At 100 ms ahead the network is off by 7.1 mm/s (RMSE); ridge 13.0; persistence 21.4."


def test_comparison_sorts_by_error_and_relates_the_network_to_each_model(run_folder):
    rows = comparison_rows(read_facts(run_folder), horizon=5)
    errors = [row.rmse for row in rows]
    assert errors == sorted(errors)
    network = next(row for row in rows if row.is_network)
    assert network.change is None
    for row in rows:
        if not row.is_network:
            assert row.change == pytest.approx(network.rmse / row.rmse - 1)


def test_a_network_worse_than_a_baseline_is_called_worse(run_folder):
    def change(scores):
        scores["models"]["network"]["overall"]["10"] = mae(50.0)

    edit_scores(run_folder, change)
    facts = read_facts(run_folder)
    assert "higher than the best baseline" in verdict_lines(facts)[0]
    assert comparison_rows(facts)[-1].model == NETWORK


def test_outputs_in_different_units_have_no_common_unit(run_folder):
    def change(scores):
        scores["targets"][1]["unit"] = "bar"

    edit_scores(run_folder, change)
    facts = read_facts(run_folder)
    assert facts.unit == ""
    assert not facts.averaged
    line = headline(facts)
    assert "mm/s in boom cylinder velocity" in line
    assert "bar in stick cylinder velocity" in line
    assert not any("best baseline" in line for line in verdict_lines(facts))
    # Nor do tables and tiles show a mean of speeds and pressures.
    assert all(table.columns[1].heading not in ("RMSE", "MAE") for table in comparison_tables(facts))
    assert [unit for _, unit, _ in key_figures(facts)[:3]] == ["mm/s", "bar", "mm/s"]
    assert spread_text(facts) == ""


def test_outputs_without_a_unit_are_never_averaged(run_folder):
    def change(scores):
        for target in scores["targets"]:
            target["unit"] = "1"

    edit_scores(run_folder, change)
    facts = read_facts(run_folder)
    assert not facts.averaged
    assert "network is off by (RMSE) 4.68 in boom cylinder velocity" in headline(facts)
    assert " 1 " not in headline(facts)


def test_the_headline_is_the_verdict_and_lost_outputs_are_named(run_folder):
    def change(scores):
        name = scores["targets"][1]["name"]
        # At one horizon alone: a network that leads at the others is of no use there.
        best = scores["models"]["persistence"]["overall"]["10"][name]
        best["rmse"] = 0.5 * scores["models"]["network"]["overall"]["10"][name]["rmse"]

    assert "a baseline has less error" not in " ".join(verdict_lines(read_facts(run_folder)))
    edit_scores(run_folder, change)
    facts = read_facts(run_folder)
    name = facts.targets[1].name
    line = f"At some time ahead a baseline has less error on 1 of 3 outputs: {name} at k = 10 "
    assert f"{line}(Persistence: 50 % less RMSE)." in verdict_lines(facts)
    verdict = network_verdict(facts.scores)
    assert headline(facts).startswith(verdict.sentence())
    assert verdict.exit_code == 0


def test_test_logs_are_named_with_what_they_cannot_prove(run_folder):
    facts = read_facts(run_folder)
    judged = list(facts.scores.models[NETWORK].recordings)
    assert any(judged[0] in line and line.startswith("Judged on") for line in verdict_lines(facts))

    def scores(*names):
        network = replace(facts.models[NETWORK], recordings={name: {} for name in names})
        return replace(facts.scores, models={NETWORK: network})

    trained = Provenance(data=DataOrigin(train=DataPart(names=("dig_1", "travel_1"))))
    assert describe_evaluation(scores(), trained) == ""
    assert "So few that one odd log decides" in describe_evaluation(scores("dig_2", "dig_3"), trained)
    same = describe_evaluation(scores("dig_2", "dig_3", "dig_4"), trained)
    assert same == (
        "Judged on 3 test logs: dig_2, dig_3 and dig_4. All are of one kind; the figure says nothing of travel."
    )
    assert "kind" not in describe_evaluation(scores("dig_2", "dig_3", "travel_4"), trained)
    assert "and others" in describe_evaluation(scores(*(f"{i}" for i in range(9))), trained)


def test_verdict_names_what_exceeds_the_budget(run_folder):
    assert any("exceeded in" in line and "Flash" in line for line in verdict_lines(read_facts(run_folder)))


def test_recordings_won_counts_only_recordings_both_have(run_folder):
    def change(scores):
        recordings = scores["models"]["persistence"]["recordings"]
        recordings.pop(next(iter(recordings)))

    edit_scores(run_folder, change)
    assert recordings_won(read_facts(run_folder), "persistence") == (3, 3)


def test_spread_is_a_sentence_with_the_median(run_folder):
    facts = read_facts(run_folder)
    median = facts.models[NETWORK].spread["10"]["median"]
    assert f"median of {median:.2f}" in spread_text(facts)


def test_a_cut_off_last_line_of_history_is_left_out(run_folder):
    path = run_folder / "history.jsonl"
    whole = path.read_text()
    path.write_text(whole[: len(whole) - 30])
    assert len(read_facts(run_folder).history) == len(whole.splitlines()) - 1


def test_a_damaged_line_inside_history_is_named(run_folder):
    path = run_folder / "history.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], "{broken", *lines[1:]]))
    with pytest.raises(StorageError, match="line 2"):
        read_facts(run_folder)


@pytest.mark.parametrize("name", ["scores.json", "predictions.safetensors", "footprint.json"])
def test_a_damaged_part_is_named(run_folder, name):
    (run_folder / name).write_bytes(b"half a fi")
    with pytest.raises(StorageError, match=name):
        read_facts(run_folder)


@pytest.mark.parametrize("content", [b"[task", b"\xff\xfe", b"a = 1\na = 2\n"])
def test_damaged_settings_are_named_and_not_shown(run_folder, content):
    (run_folder / "config.toml").write_bytes(content)
    with pytest.raises(StorageError, match=r"config\.toml"):
        read_facts(run_folder)


def test_scores_and_predictions_of_different_evaluations_are_refused(run_folder):
    edit_scores(run_folder, lambda scores: scores["task"].update(horizons=[1, 10]))
    with pytest.raises(DataError, match="edp evaluate"):
        read_facts(run_folder)


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(StorageError, match="not a run folder"):
        read_facts(tmp_path)
    with pytest.raises(StorageError, match="no run folder"):
        read_facts(tmp_path / "nowhere")


def test_without_a_rate_horizons_are_in_samples(run_folder):
    edit_scores(run_folder, lambda scores: scores["task"].pop("rate_hz"))
    (run_folder / "provenance.json").unlink()
    facts = read_facts(run_folder)
    assert [horizon_text(facts, k) for k in (1, 10)] == ["1 sample", "10 samples"]


@pytest.mark.parametrize(
    ("value", "text"),
    [(720000.0, "720,000"), (13.04, "13.0"), (-0.0123, "−0.0123"), (None, "–"), (float("nan"), "–"), (0.0, "0.0")],
)
def test_numbers_show_three_digits(value, text):
    assert number(value) == text


def test_wording_of_columns_shares_and_spans():
    assert decimals_for([12.0, 7.1, None, 0.0]) == 2
    assert number(-0.001, 2, signed=True) == "0.00"
    assert (percent(-0.394), percent(0.0623, signed=True)) == ("−39 %", "+6.2 %")
    assert (duration(0.0), duration(90.0), duration(7200.0)) == ("0 s", "1.5 min", "2.0 h")
    assert (listed(["a"]), listed(["a", "b", "c"]), listed([])) == ("a", "a, b and c", "")


def test_figures_stay_on_the_line_of_their_unit_and_name():
    assert unbroken("off by 7.1 mm/s on average; ridge 13.0.") == "off by 7.1\u00a0mm/s on average; ridge\u00a013.0."


def limit_of(**changes):
    table = {"mae": [[1, 1, 1, 0.32], [6, 5, 4, 5.04]], "low": [[0, 0, 0, 0.3], [4, 4, 4, 4.1]]}
    table["high"] = [[1, 1, 1, 0.35], [7, 7, 7, 6.2]]
    known = {name: [[0, 0, 0, 0.3], [0, 0, 0, 0.33]] for name in ("mae", "low", "high")}
    tables = {"commands_unknown": table, "commands_known": known, "persistence": known}
    targets = ["CylVels_1", "CylVels_2", "CylVels_3"]
    counts = {"schema": 1, "confidence": 0.95, "moments": 8, "branches": 4, "recordings": 2, "seed": 0}
    return {"unit": "mm/s", "rate_hz": 100.0, "horizons": [1, 10], "targets": targets, **counts, **tables, **changes}


def test_the_limit_of_the_data_becomes_a_line(run_folder, tmp_path):
    data = tmp_path / "data"
    data.mkdir()
    write_json(data / "limit.json", limit_of())
    assert not any("limit of predictability" in line for line in verdict_lines(read_facts(run_folder)))
    for place in (data, data / "limit.json"):
        (line,) = [text for text in verdict_lines(read_facts(run_folder, place)) if "limit" in text]
        assert "5.0 mm/s (95 %: 4.1 to 6.2)" in line
        assert "its error would be 0.33" in line
    provenance = json.loads((run_folder / "provenance.json").read_text())
    provenance["data"]["reader"] = {"path": str(data)}
    write_json(run_folder / "provenance.json", provenance)
    assert any("limit of predictability" in line for line in verdict_lines(read_facts(run_folder)))


@pytest.mark.parametrize("change", [{"horizons": [1, 20]}, {"rate_hz": 50.0}, {"targets": ["a", "b", "c"]}])
def test_a_limit_of_other_signals_or_horizons_is_not_shown(run_folder, tmp_path, change):
    path = tmp_path / "limit.json"
    write_json(path, limit_of(**change))
    assert not any("limit of predictability" in line for line in verdict_lines(read_facts(run_folder, path)))


def test_a_file_that_is_no_limit_is_refused(run_folder, tmp_path):
    path = tmp_path / "limit.json"
    path.write_text("{}")
    with pytest.raises(StorageError, match="'horizons' is missing"):
        read_facts(run_folder, path)
