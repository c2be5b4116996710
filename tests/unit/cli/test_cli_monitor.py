"""``edp monitor fit`` and ``run``: a folder, an alarm log, exit codes, and what is refused."""

import csv
import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from edp.config.monitor import load_monitor_experiment
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.monitor.monitor_file import load_monitor
from edp.recording import Recording
from edp.signals import TABLE_A1, VOCABULARY
from edp.storage import write_json
from edp.storage.run_listing import list_runs
from edp.testing.monitor import rig_sessions
from edp.workflows.monitor import fit_monitor

RESULT = "monitor_run.json"

pytestmark = pytest.mark.long
NAMES = ("BmUp", "CylVels_1", "CylStroke_1", "CylPressures_1", "CylPressures_5")
"""Of the rig's channels, so that logs need no map."""
TICKS = 2000


def logs(count, first=0):
    channels = tuple(VOCABULARY[name] for name in NAMES)
    return [
        Recording(session.name, channels, session.values, session.rate_hz)
        for session in rig_sessions(count, TICKS, seed=4, first=first)
    ]


def write(recordings, folder):
    folder.mkdir()
    for recording in recordings:
        write_recording(recording, folder / f"{recording.name}.parquet")
    return folder


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    return write(logs(18), tmp_path_factory.mktemp("logs") / "healthy")


@pytest.fixture(scope="module")
def fitted(healthy, tmp_path_factory):
    folder = tmp_path_factory.mktemp("monitors") / "rig"
    experiment = load_monitor_experiment(None, (), {"hours_per_false_alarm": 0.06, "minutes": 0.05})
    fit_monitor([], DataSource.from_path(healthy), experiment, folder)
    return folder


def test_fit_says_what_is_watched_and_promised_and_two_workers_give_the_same_monitor(edp, healthy, fitted, tmp_path):
    folder = tmp_path / "monitor"
    options = ("--hours-per-false-alarm", 0.06, "--time-budget", "0.05min", "--workers", 2, "--json")
    ended = edp("monitor", "fit", healthy, "--out", folder, *options)
    assert ended.code == 0, ended.err
    facts = ended.json
    assert facts["workers"] == 2
    assert (folder / "monitor.json").is_file()
    assert (folder / "config.toml").is_file()
    assert "virtual:CylVels_1" in facts["residuals"]
    assert "asked for one in 0.06 h" in facts["promise"]
    assert facts["doubtful"] == []
    one, two = load_monitor(fitted), load_monitor(folder)
    assert one.limit == two.limit
    for before, after in zip(one.chain.watches, two.chain.watches, strict=True):
        np.testing.assert_array_equal(before.matrix, after.matrix)
    assert one.provenance["trained_on"] == two.provenance["trained_on"]
    session = logs(1, first=30)[0]
    residuals = [m.residuals(session.select(m.inputs), m.initial_state())[0] for m in (one, two)]
    np.testing.assert_array_equal(*residuals)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--machine", "M99"), "unknown machine 'M99'; known: C14, M22"),
        (("--set", 'dictionary.kinds=["leak"]'), "leak"),
        (("--hours-per-false-alarm", -1), "hours_per_false_alarm = -1"),
        (("--time-budget", "-1min"), "time_budget_min = -1"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_trained(edp, healthy, tmp_path, options, told):
    ended = edp("monitor", "fit", healthy, "--out", tmp_path / "monitor", "--hours-per-false-alarm", 0.06, *options)
    assert ended.code == 1
    assert told in ended.err
    assert "virtual sensors" not in ended.err
    assert not (tmp_path / "monitor" / "monitor.json").exists()


def test_alarms_are_logged_and_end_with_exit_code_5(edp, fitted, tmp_path):
    folder = fitted
    faulty = logs(1, first=40)[0]
    values = faulty.values.copy()
    values[800:, 3] += np.float32(4e6)
    where = write([replace(faulty, values=values)], tmp_path / "today")
    out = tmp_path / "watched"
    ended = edp("monitor", "run", folder, where, "--out", out)
    assert ended.code == 5
    rows = [json.loads(line) for line in (out / "alarms.jsonl").read_text().splitlines()]
    assert rows
    assert all(row["recording"] == faulty.name for row in rows)
    assert any(row["raised_s"] > 8.0 and row["sentence"] for row in rows)
    with (out / "alarms.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["raised_s"]) for row in table] == [row["raised_s"] for row in rows]
    shown = edp("monitor", "report", out, "--json")
    assert shown.code == 0, shown.err
    facts = json.loads(shown.out)
    assert facts["headline"].startswith(f"{len(rows)} alarm")
    assert faulty.name in (out / "report.html").read_text()
    as_json = edp("monitor", "run", folder, where, "--json")
    assert as_json.code == 5
    assert len(json.loads(as_json.out)["alarms"]) == len(rows)


def test_a_log_that_lacks_a_channel_is_watched_with_the_rest(edp, fitted, tmp_path):
    folder = fitted
    part = logs(1, first=41)[0]
    part = Recording(part.name, part.channels[:4], part.values[:, :4].copy(), part.rate_hz)
    ended = edp("monitor", "run", folder, write([part], tmp_path / "part"))
    assert "lacks CylPressures_5" in " ".join(ended.out.split())
    assert ended.code in (0, 5)


def test_too_few_hours_are_one_message_before_anything_is_written(edp, healthy, tmp_path):
    ended = edp("monitor", "fit", healthy, "--out", tmp_path / "m")
    assert ended.code == 1
    assert "supports one in" in " ".join(ended.err.split())
    assert not (tmp_path / "m").exists() or not any((tmp_path / "m").iterdir())


def test_what_is_remarked_of_logs_stands_on_the_page_and_a_damaged_remark_is_refused(edp, fitted, tmp_path):
    out = tmp_path / "watched"
    assert edp("monitor", "run", fitted, write(logs(1, first=42), tmp_path / "day"), "--out", out).code in (0, 5)
    run = json.loads((out / RESULT).read_text())
    assert "unlike" not in run
    write_json(out / RESULT, run | {"unlike": {"<b>monday": "all axes are off"}})
    assert edp("monitor", "report", out).code == 0
    assert "Of &lt;b&gt;monday: all axes are off." in (out / "report.html").read_text()
    for damaged in ([], {"monday": 3}, {"monday": "x" * 5000}, {"monday": ["a", None]}):
        write_json(out / RESULT, run | {"unlike": damaged})
        ended = edp("monitor", "report", out)
        assert ended.code == 1
        assert "run the monitor again" in " ".join(ended.err.split())


def test_a_result_of_an_earlier_version_is_read(edp, fitted, tmp_path):
    out = tmp_path / "watched"
    assert edp("monitor", "run", fitted, write(logs(1, first=42), tmp_path / "day"), "--out", out).code in (0, 5)
    for name in ("provenance.json", "status.json"):
        (out / name).unlink()
    (out / RESULT).rename(out / "run.json")
    assert edp("monitor", "report", out).code == 0
    (row,) = list_runs(tmp_path)[0]
    assert (row.kind, row.state) == ("monitor run", "finished")


def test_logs_in_two_folders_are_read_together(edp, healthy, tmp_path):
    paths = sorted(healthy.iterdir())
    halves = [tmp_path / name for name in ("monday", "tuesday")]
    for half, chosen in zip(halves, (paths[::2], paths[1::2]), strict=True):
        half.mkdir()
        for path in chosen:
            shutil.copy(path, half)
    ended = edp(
        "monitor", "fit", *halves, "--out", tmp_path / "m", "--hours-per-false-alarm", 0.06, "--time-budget", "0.05min"
    )
    assert ended.code == 0, ended.err
    together = load_monitor(tmp_path / "m")
    assert together.provenance["sessions"] == len(paths)


def test_run_folders_without_logs_are_refused(edp, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text("{}")
    ended = edp("monitor", "fit", tmp_path / "run", "--out", tmp_path / "m")
    assert ended.code == 1
    assert "got run folders alone, expected healthy logs" in " ".join(ended.err.split())
    assert not (tmp_path / "m").exists()


def test_bad_input_is_one_message(edp, fitted, healthy, tmp_path):
    folder = fitted
    for arguments in (
        ("monitor", "run", tmp_path, healthy),
        ("monitor", "run", folder, tmp_path / "nothing"),
        ("monitor", "report", tmp_path),
        ("monitor", "fit", tmp_path / "no_run", healthy, "--out", tmp_path / "m"),
        ("monitor", "fit", healthy, "--out", tmp_path / "m", "--set", "chain.block=2"),
    ):
        ended = edp(*arguments)
        assert ended.code == 1, arguments
        assert "Traceback" not in ended.err
        assert ended.err.strip()
    assert set(NAMES) - {"CylStroke_1"} <= set(TABLE_A1)
