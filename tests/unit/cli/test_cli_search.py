"""``edp search`` as a newcomer meets it: a small study, its state, its export, a stop, wrong words."""

import os
import signal

import pytest
from small_studies import CHANGES


@pytest.fixture
def command(logs, tmp_path):
    changes = [part for change in CHANGES for part in ("--set", change)]
    return ("search", logs, "--study", tmp_path / "study", "--workers", 1, *changes)


@pytest.mark.timeout(600)
def test_a_study_its_state_and_its_export(edp, command, tmp_path):
    study = tmp_path / "study"
    made = edp(*command, "--phase", "calibration", "--json").json
    assert (made["state"], made["phases"], made["trained_now"]) == ("stopped", ["isolation", "calibration"], 10)
    assert made["teacher"] is None
    again = edp(*command, "--phase", "calibration")
    assert again.code == 0
    assert "stopped; 0 trainings now" in again.out
    assert "Feature set" in again.out
    shown = edp("search", "status", study)
    assert "10 trainings done, 0 running" in shown.out
    assert "nobody now" in shown.out
    held = edp("search", "status", study, "--json").json
    assert [phase["trained"] for phase in held["phases"]] == [8, 2]
    assert "FG2" in (study / "report.html").read_text(encoding="utf-8")
    page = edp("search", "report", study, "--out", tmp_path / "page", "--no-pictures", "--json").json["report"]
    assert page == str(tmp_path / "page" / "report.html")
    assert not (tmp_path / "page" / "pictures").exists()
    export = edp("search", "export", study, "--json").json
    assert export["studies"] == ["calibration lstm"]


@pytest.mark.timeout(600)
def test_ctrl_c_leaves_a_study_that_goes_on(edp, command, tmp_path, start, stop_once):
    records = tmp_path / "study/ledger/records"

    def three():
        return records.is_dir() and len(os.listdir(records)) >= 3

    code, err = stop_once(start(*command, "--phase", "isolation"), three, signal.SIGINT)
    assert code == 130
    assert "same command" in err
    assert "Traceback" not in err
    done = edp("search", "status", tmp_path / "study", "--json").json
    assert done["state"] == "stopped"
    made = edp(*command, "--phase", "isolation", "--json").json
    assert 0 < made["trained_now"] <= 5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--preset", "quik"), "did you mean 'quick'"),
        (("--phase", "screning"), "did you mean 'screening'"),
        (("--set", "search.mode=fast"), "sound or thesis"),
        (("--workers", "-1"), "0 <= count <= 4,096 must hold"),
        (("--set", "search.calibration.trails=3"), "did you mean 'trials'"),
        (("--set", "search.limits={flops=3}"), "limits.flops"),
    ],
)
def test_wrong_words_are_told_in_one_line_and_nothing_is_begun(edp, command, tmp_path, options, message):
    ended = edp(*command, *options)
    assert ended.code == 1
    assert message in ended.err
    assert not (tmp_path / "study" / "ledger" / "records").exists()


def test_state_and_export_of_no_study(edp, tmp_path):
    for name in ("status", "export", "report"):
        ended = edp("search", name, tmp_path)
        assert ended.code == 1
        assert "holds no study" in ended.err


def test_help_names_the_commands_and_the_options(edp):
    assert "status" in edp("search", "--help").out
    assert "--preset" in edp("search", "run", "--help").out
