"""Long commands divide their loops among workers: the same results for any number of them, and after a kill."""

import contextlib
import inspect as source_of
import json
import os
import re
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.main import get_command

from edp.cli import app
from edp.errors import StorageError
from edp.logs import write_recording
from edp.recording import Recording
from edp.report.run.facts import read_history
from edp.signals import VOCABULARY
from edp.storage import read_json
from edp.storage.seals import HASH
from edp.testing.monitor import rig_sessions
from edp.testing.twins import sample_actuators

pytestmark = [pytest.mark.long, pytest.mark.processes]
LINE = ("--set", "task.length_m=[0.4,0.5]", "--set", "task.hold_s=0.2")
RIG = ("BmUp", "CylVels_1", "CylStroke_1", "CylPressures_1", "CylPressures_5")
TRIALS = (
    *("trials.random_sets=1", "training.epochs=1", "training.updates=2", "screen.max_lag=20", "screen.min_segments=4"),
    *("screen.information_samples=200", "screen.rank_samples=200", "screen.segment_samples=100"),
    *(
        "screen.forest.trees=5",
        "screen.forest.samples=200",
        "screen.forest.test_samples=100",
        "screen.forest.repeats=2",
    ),
)
TWIN = (
    *("twin.kind=recurrent", "twin.units=6", "twin.members=3", "twin.prefix_ticks=20", "training.batch=4"),
    *("training.lengths_s=[0.2]", "training.updates=[6]", "training.validate_every=3", "evaluation.duration_s=4"),
    *("evaluation.starts=2", "evaluation.at_s=[1, 4]"),
)
AUTO = (
    "auto.candidates=['linear','recurrent']",
    "task.targets=['CylVels_1']",
    "task.horizons=[5]",
    "evaluation.baselines=[]",
)
LIMIT = ("limit.moments=4", "limit.branches=4")
FLEET = ("finetune.single_phase_epochs=2", "finetune.batch=4", "finetune.check_signs=false")


def settings(values):
    """Return values as options."""
    return [word for value in values for word in ("--set", value)]


@dataclass(frozen=True)
class Divided:
    """A command whose loop is divided.

    Attributes:
        words: after the name of the command; ``{out}`` is the folder of the result.
        is_slow: takes seconds more than the others.
        writes: whether it writes a folder; otherwise its results are what it prints.
    """

    words: tuple[str, ...]
    is_slow: bool = False
    writes: bool = True


LONG_COMMANDS = {
    "simulate": Divided(
        (
            "{out}",
            "--duration",
            "24s",
            "--recordings",
            "4",
            "--limit",
            *settings(LIMIT),
        )
    ),
    "data store build": Divided(("{logs}", "--out", "{out}")),
    "data check": Divided(("{logs}", "--json"), writes=False),
    "data screen": Divided(("{logs}", "--out", "{out}", "--no-pictures", "--trials", *settings(TRIALS)), True),
    "evaluate": Divided(("{run}", "--baselines", "persistence,ridge_arx,small_mlp")),
    "train finetune": Divided(("{run}", "{log}", "--out", "{out}", "--baselines", "low_rank", *settings(FLEET)), True),
    "fleet report": Divided(("{run}", "{fleet}", "--out", "{out}")),
    "train run": Divided(("{logs}", "--out", "{out}", "--time-budget", "1.2s", *settings(AUTO)), True),
    "twin": Divided(("{actuators}", "--out", "{out}", *settings(TWIN)), True),
    "monitor fit": Divided(("{rig}", "--out", "{out}", "--hours-per-false-alarm", "0.06", "--time-budget", "3s"), True),
    "monitor run": Divided(("{monitor}", "{rig}", "--out", "{out}")),
    "loop run": Divided(("{out}", "--task", "grade", "--controller", "pi", "--loops", "3", *LINE)),
    "loop tune": Divided(
        ("{out}", "--controller", "pi", "--evaluation-loops", "2", "--trials", "3", "--tuning-loops", "2", *LINE), True
    ),
}
"""Commands with a loop that is divided."""
WHOLE = {
    "train pretrain": "one training: a node of a cluster does it, several processes would have nothing to do",
    "compress distil": "one training",
    "compress search": "each stage begins with what the stage before chose",
    "calibrate": "stages of one fit, each of which begins where the one before ended",
    "adapt run": "one recursive fit along the logs, in their order",
    "adapt replay": "one pass along the logs, in their order",
    "rollout": "one pass along a log",
    "data add-forecasts": "one pass along a log",
    "doctor": "compiles, once for an installation",
    "init": "reads heads of logs, which takes seconds",
    "search run": "trainings, which `tests/unit/search` divides and kills",
    "search report": "writes a page",
    "search status": "reads the state of a study",
    "search export": "writes a copy of a study",
    "monitor report": "writes a page",
    "fleet network": "writes one bundle",
    "data store verify": "reads samples as fast as the disk gives them",
}
"""Commands that report progress, or stand beside one that does, and why their loop is not divided here."""
TIMES = {
    *("seconds", "wall_s", "time", "created", "finished", "started", "processor_s", "found_effort", "blake2b", "run"),
    *("targets_per_s", "solve_us", "solve_us_median", "missed", "written_ns", "changed_ns", "key", "folder", "path"),
    *("store", "workers", "environment", "sources", "command"),
}
"""Keys of results that differ from call to call, or name the folder."""


def leaves(node=None, words=()):
    """Yield each command with its words."""
    node = node or get_command(app)
    below = getattr(node, "commands", None)
    if below is None:
        yield " ".join(words), node
        return
    for name, inner in below.items():
        yield from leaves(inner, (*words, name))


def test_every_command_with_progress_is_divided_or_says_why_not():
    modules = {name: source_of.getsource(source_of.getmodule(node.callback)) for name, node in leaves()}
    long = {name for name, text in modules.items() if "show_progress(" in text}
    long |= {"data screen", "search run"}  # displays of their own
    assert long <= {*LONG_COMMANDS, *WHOLE}
    assert not LONG_COMMANDS.keys() & WHOLE.keys()
    for name, node in leaves():
        options = {option for parameter in node.params for option in parameter.opts}
        if name in LONG_COMMANDS:
            assert {"--workers", "--cluster", "--open-cluster"} <= options, name
        elif name not in ("train pretrain", "search run"):
            assert not {"--workers", "--cluster"} & options, name


@pytest.fixture(scope="module")
def places(tmp_path_factory, logs, _trained):
    """Inputs of the commands, made once."""
    from edp.config.monitor import load_monitor_experiment
    from edp.logs.source import DataSource
    from edp.workflows.monitor import fit_monitor

    top = tmp_path_factory.mktemp("long")
    for name in ("actuators", "rig"):
        (top / name).mkdir()
    for seed in range(6):
        write_recording(sample_actuators(seed=seed), top / "actuators" / f"log_{seed}.parquet")
    channels = tuple(VOCABULARY[name] for name in RIG)
    for session in rig_sessions(18, 2000, seed=4, first=0):
        recording = Recording(session.name, channels, session.values, session.rate_hz)
        write_recording(recording, top / "rig" / f"{session.name}.parquet")
    experiment = load_monitor_experiment(None, (), {"hours_per_false_alarm": 0.06, "minutes": 0.05})
    fit_monitor([], DataSource.from_path(top / "rig"), experiment, top / "monitor")
    entries = "".join(
        f'[[recordings]]\npath = "{log}"\nmachine = "digger {number // 2}"\n'
        for number, log in enumerate(sorted(logs.iterdir()))
    )
    (top / "fleet.toml").write_text(entries)
    DataSource.from_path(top / "fleet.toml").store(top / "fleet")
    return {
        "logs": logs, "log": sorted(logs.iterdir())[0], "run": _trained, "monitor": top / "monitor",
        "fleet": top / "fleet", "actuators": top / "actuators", "rig": top / "rig",
    }  # fmt: skip


def words_of(command, places, out):
    """Return a command line, with a copy of the run that it writes into."""
    named = dict(places, out=out)
    if command == "evaluate":
        named["run"] = out if out.exists() else shutil.copytree(places["run"], out)
    return [*command.split(), *(word.format(**named) for word in LONG_COMMANDS[command].words)]


def without_times(value):
    """Return a table without what differs from call to call."""
    if isinstance(value, dict):
        return {key: without_times(part) for key, part in value.items() if key not in TIMES}
    return [without_times(part) for part in value] if isinstance(value, list) else value


def results_in(folder):
    """Return the content of the result files of a folder by name."""
    found = {}
    for file in sorted(folder.rglob("*")):
        name = str(file.relative_to(folder))
        if not file.is_file() or file.name in ("status.json", "run.json", "provenance.json", ".lock", "progress.json"):
            continue
        if file.suffix == ".json":
            found[name] = without_times(json.loads(file.read_text()))
        elif file.suffix in (".parquet", ".safetensors", ".csv", ".f32", ".toml") and "checkpoint" not in name:
            found[name] = file.read_bytes()
    return found


def differences(found, usual, where):
    """Yield each place at which two results differ, with both values."""
    if isinstance(found, dict) and isinstance(usual, dict) and found.keys() == usual.keys():
        for key in found:
            yield from differences(found[key], usual[key], f"{where}, {key}")
    elif isinstance(found, list) and isinstance(usual, list) and len(found) == len(usual):
        for number, pair in enumerate(zip(found, usual, strict=True)):
            yield from differences(*pair, f"{where}, {number}")
    elif found != usual:
        yield f"{where}: {str(found)[:60]}, {str(usual)[:60]}"


def assert_same(command, found, usual):
    """Compare results, and name the file that differs."""
    names = [{name for name in one if "networks/" not in name} for one in (found, usual)]
    assert names[0] == names[1], command
    for name in sorted(names[0]):
        assert list(differences(found[name], usual[name], f"{command}, {name}")) == []


@pytest.fixture(scope="module")
def usual(places, tmp_path_factory):
    """Results of each command in one process, found once."""
    found = {}

    def find(command, run):
        if command not in found:
            out = tmp_path_factory.mktemp("usual") / "out"
            text = run(*words_of(command, places, out), "--workers", 1)
            found[command] = results_in(out) if LONG_COMMANDS[command].writes else text
        return found[command]

    return find


@pytest.fixture
def run(edp):
    """Run a command that must succeed, also with a verdict or an alarm; returns what it printed."""

    def call(*words):
        until = time.monotonic() + 30.0
        ended = edp(*words)
        while ended.code == 75 and time.monotonic() < until:  # workers of a killed command are still ending
            time.sleep(0.2)
            ended = edp(*words)
        assert ended.code in (0, 3, 5, 6), ended.err
        return ended.out

    return call


FAST = ("data check", "loop run", "evaluate")
REFUSED = re.compile("changed since|match its hash")
READ_AGAIN = (
    "report {run}",
    "evaluate {run} --baselines persistence",
    "monitor report {out}",
    "export {out} --to onnx --out {out}/exported",
)
"""Commands that read results, tried in turn until one refuses the changed file; the command itself is the last.

``run`` is the innermost run that holds the file.
"""
READ_BY_PYTHON = {
    "transfer.json": "`edp.report.transfer` builds the page from it",
    "results.json": "`edp.report.control` builds the page from it",
    "controller/controller.json": "`edp live` and exports of controllers load it",
    "fleet_report.json": "for programs of others; EDP never reads it",
    "quality.json": "for programs of others, beside the page that shows it",
    "screening.json": "for programs of others, beside the page that shows it",
    "trials.json": "for programs of others, beside the page that shows it",
    "history.jsonl": "for programs of others, where a twin or a copied network has no report of its training",
}
"""Files without a command that reads them here, and who does."""


def with_one_change(content):
    """Return a table with another value at the first place that is neither its schema nor its hash."""
    for key, value in content.items():
        if key in ("schema", "kind", HASH):
            continue
        if isinstance(value, dict) and value:
            changed = with_one_change(value)
            if changed == value:
                continue
            return content | {key: changed}
        return content | {key: 17 if value != 17 else 18}
    return content


@pytest.mark.parametrize(
    "command",
    [
        pytest.param(command, marks=pytest.mark.slow if divided.is_slow else ())
        for command, divided in LONG_COMMANDS.items()
        if divided.writes
    ],
)
def test_every_file_of_a_result_is_refused_once_changed(run, edp, places, tmp_path, command):
    out = tmp_path / "out"
    words = [*words_of(command, places, out), "--workers", 1]
    run(*words)
    files = [file for file in sorted(out.rglob("*.json*")) if file.stat().st_size]
    assert files
    for file in files:
        whole, name = file.read_text(), str(file.relative_to(out))
        first, *rest = whole.splitlines(keepends=True) if file.suffix == ".jsonl" else [whole]
        changed = with_one_change(json.loads(first))
        assert changed != json.loads(first), name
        file.write_text("".join([json.dumps(changed) + "\n", *rest]))
        with pytest.raises(StorageError, match=REFUSED):
            read_history(file) if file.suffix == ".jsonl" else read_json(file)
        inner = next((folder for folder in file.parents if (folder / "run.json").exists()), out)
        lines = [line.format(out=out, run=inner).split() for line in READ_AGAIN]
        said = (ended.out + ended.err for ended in (edp(*line) for line in (*lines, words)))
        known = any(name.endswith(known) for known in READ_BY_PYTHON)
        assert known or any(map(REFUSED.search, said)), f"{name}: no command refuses it"
        file.write_text(whole)


@pytest.mark.parametrize(
    ("command", "workers"),
    [
        pytest.param(command, workers, marks=() if command in FAST and workers == 2 else pytest.mark.slow)
        for command in LONG_COMMANDS
        for workers in (2, 4)
    ],
)
def test_any_number_of_workers_gives_the_same_results(run, places, usual, tmp_path, command, workers):
    out = tmp_path / "out"
    said = run(*words_of(command, places, out), "--workers", workers)
    if not LONG_COMMANDS[command].writes:
        assert without_times(json.loads(said)) == without_times(json.loads(usual(command, run)))
    else:
        assert_same(command, results_in(out), usual(command, run))
        assert not (out / "units").exists()


class Changes:
    """Counts the changes of the files in a folder between looks; true from a number of changes on."""

    def __init__(self, folder, count):
        self.folder, self.seen, self.count = folder, set(), 0
        self()
        self.count = len(self.seen) + count

    def __call__(self):
        for folder, _, names in os.walk(self.folder):  # passes over what vanishes meanwhile
            for name in names:
                with contextlib.suppress(FileNotFoundError):
                    self.seen.add((folder, name, Path(folder, name).stat().st_mtime_ns))
        return len(self.seen) >= self.count


KILLS = (1, 2, 3, 5, 8, 12, 17, 23, 30, 40)
"""Changes of files after which a command is killed."""


@pytest.mark.parametrize(
    ("command", "changes"),
    [
        pytest.param(command, changes, marks=() if command == "monitor run" and changes == 12 else pytest.mark.slow)
        for command, divided in LONG_COMMANDS.items()
        if divided.writes
        for changes in KILLS
    ],
)
def test_a_killed_command_continues_to_the_same_results(
    run, places, usual, start, stop_once, tmp_path, command, changes
):
    out = tmp_path / "out"
    words = [*words_of(command, places, out), "--workers", 1 + changes % 2]
    code, said = stop_once(start(*words), Changes(out, changes), signal.SIGKILL)
    # A command that ends before it is looked at is as good as one that was not killed.
    assert code in (-signal.SIGKILL, 0, 3, 5, 6), said
    run(*words)
    assert_same(command, results_in(out), usual(command, run))
