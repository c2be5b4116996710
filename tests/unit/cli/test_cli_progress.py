"""Every progress display with a total: never above it, and no time left of zero while work goes on."""

import ast
import re
from pathlib import Path
from types import SimpleNamespace

import pytest

from edp.cli import console
from edp.cli.console import BoundedProgress, Steps, TimeLeft, count_text, format_time_left, progress
from edp.cli.progress import Display, StageDisplay
from edp.cli.screen import ScreeningDisplay
from edp.training import TrainingProgress
from edp.training.fitted_twin import FreeRunProgress
from edp.training.progress_steps import free_run_steps, training_steps

COMMANDS = Path(console.__file__).parent


def epoch(number):
    return TrainingProgress(number, 2, 10, 10, 1e5, 0.0, {"best": True, "validation_mae": 1.0})


def steps():
    return Steps(quiet=False, every_s=0.0)


def train(shown):
    models = display(shown, "train").stage("model", 2)
    for done in (0, 1, 2, 3):
        models.step(done)
        models.note("ridge")
        report = training_steps(models)
        for number in (1, 2, 3):
            report(epoch(number))


def fit(shown):
    report = free_run_steps(display(shown, "twin"))
    for update in (1, 64, 88):
        report(FreeRunProgress(update, 64, 1.0, 0.2 if update == 1 else 0.0, None, False))


def screening(shown):
    display = ScreeningDisplay(shown, steps())
    for done in (0, 1, 2, 3):
        display.on_progress("ranks", done / 2)
        display.on_trial("x", done, 2, epoch(3))


def search(shown):
    phase = display(shown, "search", "trainings done").stage("phase 1 of 8, isolation")
    trainings = phase.stage("training", 2)
    for done in (0, 2, 5):
        trainings.step(done, share=done / 2, seconds_left=0.2, trained=done, workers=2)


def logs(shown):
    reading = display(shown, "read").stage("log", 2)
    for number in (0, 1, 2, 3):
        reading.step(number)
        reading.note("x")


def display(shown, command, counted="", timed=False):
    return StageDisplay(Display(shown, steps(), command, counted, timed))


def loops(shown):
    stage = display(shown, "control", "loops run").stage("loop", 2)
    for done in (1, 2, 3):
        stage.note("x")
        stage.step(done)
    stage.note("x")


def methods(shown):
    progress = display(shown, "finetune")
    progress.note("reads")
    stage = progress.stage("method", 2)
    for done in (1, 2, 3):
        stage.note("x")
        epochs = stage.stage("epoch", 2)
        for epoch in (1, 2, 3):
            epochs.step(epoch, share=epoch / 2, seconds_left=0.2)
        stage.step(done)


USERS = {
    "training_steps": train,
    "free_run_steps": fit,
    "ScreeningDisplay": screening,
    "search": search,
    "log": logs,
    "Display": loops,
    "StageDisplay": methods,
}


@pytest.mark.parametrize("user", USERS)
def test_no_display_exceeds_its_total_or_says_that_nothing_is_left(user, capsys):
    with progress() as shown:
        USERS[user](shown)
        assert shown.tasks
        for task in shown.tasks:
            assert 0 <= task.completed <= task.total
    text = capsys.readouterr().err
    assert text.strip()
    assert not re.search(r"\b0 s left|at most 0 s|-\d+ left", text)
    for done, total in re.findall(r"(\d+)(?:/| of )(\d+)\b", text):
        assert int(done) <= int(total), text


@pytest.mark.parametrize("change", [{"completed": 9}, {"advance": 9}, {"completed": 9, "total": 3}, {"completed": -1}])
def test_a_bar_is_cut_at_its_total(change):
    with progress() as shown:
        bar = shown.add_task("x", total=2.0, note="")
        shown.update(bar, **change)
        assert 0 <= shown.tasks[0].completed <= shown.tasks[0].total


def test_the_bar_shows_no_zero_while_it_works():
    working = SimpleNamespace(finished=False, time_remaining=0)
    assert TimeLeft().render(working).plain == ""
    working.time_remaining = 0.3
    assert TimeLeft().render(working).plain == "1 s left"
    assert TimeLeft().render(SimpleNamespace(finished=True, finished_time=3.0)).plain == "3 s"


def test_units_that_are_counted_have_a_line_where_they_begin(capsys):
    with progress() as shown:
        stage = display(shown, "control", "loops run").stage("loop", 2)
        for number, name in enumerate(("grade 0", "grade 1")):
            stage.note(name)
            assert shown.tasks[0].completed == number / 2
            stage.step(number + 1)
        assert shown.tasks[0].completed == 1.0
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["control: 0/2 loops run, now grade 0", "control: 1/2 loops run, now grade 1, 1 s left"]


def test_the_stage_of_a_training_divides_the_unit_at_work(capsys):
    with progress() as shown:
        methods = display(shown, "finetune").stage("method", 2)
        methods.step(1)
        methods.note("full")
        methods.stage("epoch", 4).step(2, seconds_left=3.0)
        assert shown.tasks[0].completed == 0.75
    assert capsys.readouterr().err.splitlines()[1:] == [
        "finetune: method 2 of 2, full",
        "finetune: method 2 of 2, full, epoch 2/4, 3 s left of it",
    ]


def test_a_training_shows_speed_and_the_best_error_so_far(capsys):
    with progress() as shown:
        whole = display(shown, "train")
        whole.note("reading recordings")
        report = training_steps(whole)
        for event in (
            TrainingProgress(1, 2, 10, 10, 1e5, 75.0, {"best": True, "validation_mae": 0.5}),
            TrainingProgress(2, 2, 5, 10, 1e5, 0.2, {"best": False, "validation_mae": 0.7}),
            TrainingProgress(1, 3, 5, 10, 1e5, 0.2, refit=True),
        ):
            report(event)
        assert whole.display.measured("validation_mae") == 0.5
    assert capsys.readouterr().err.splitlines()[1:] == [
        "train: epoch 1/2, 100,000 targets/s, validation MAE 0.5, 1 min 15 s left",
        "train: epoch 2/2, 100,000 targets/s, validation MAE 0.5, 1 s left",
        "train: refit, epoch 1/3, 100,000 targets/s, validation MAE 0.5, 1 s left",
    ]


def test_notes_of_a_command_replace_each_other(capsys):
    with progress() as shown:
        whole = display(shown, "twin")
        whole.note("static map")
        whole.stage("update", 4).step(1, length_s=2.0, free_run_error=0.25)
        whole.note("free runs")
        assert shown.tasks[0].completed == 0.25
    assert capsys.readouterr().err.splitlines() == [
        "twin: static map",
        "twin: update 1/4, runs of 2 s, free-run error 0.25 deviations",
        "twin: free runs",
    ]


def test_time_left_and_counts_of_a_plan():
    assert [format_time_left(s) for s in (0.0, -3.0, float("nan"), float("inf"))] == [""] * 4
    assert format_time_left(0.2) == ", 1 s left"
    assert format_time_left(75.0) == ", 1 min 15 s left"
    assert (count_text(2, 3), count_text(3, 3, "/"), count_text(4, 3)) == (
        "2 of 3",
        "3/3",
        "4, more than the 3 planned",
    )


def functions():
    """Functions of the command line that show progress, by file and name."""
    for file in sorted(COMMANDS.glob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                calls = {ast.unparse(c.func) for c in ast.walk(node) if isinstance(c, ast.Call)}
                if any(name.endswith((".say", "shown.update", "bars.update")) for name in calls):
                    yield file.name, node


def unplanned(node):
    """F-strings with one number over another, which could exceed it."""
    for text in (n for n in ast.walk(node) if isinstance(n, ast.JoinedStr)):
        for before, between, after in zip(text.values, text.values[1:], text.values[2:], strict=False):
            numbers = isinstance(before, ast.FormattedValue) and isinstance(after, ast.FormattedValue)
            if numbers and isinstance(between, ast.Constant) and between.value in ("/", " of "):
                yield ast.unparse(text)


def test_counts_and_times_of_progress_are_written_in_one_place():
    found = list(functions())
    assert {"progress.py", "screen.py"} <= {file for file, _ in found}
    for file, node in found:
        assert not list(unplanned(node)) or (file, node.name) == ("console.py", "count_text"), (file, node.name)
    for file in COMMANDS.glob("*.py"):
        text = file.read_text(encoding="utf-8")
        if file.name != "console.py":
            assert not re.search(r"duration\(.*\)\} left|\bmin\(1\.0, ", text), file.name


def test_the_lint_finds_what_it_forbids():
    assert list(unplanned(ast.parse("f'{done}/{total}'")))
    assert list(unplanned(ast.parse("f'log {done} of {total}'")))
    assert not list(unplanned(ast.parse("f'{done} and {total}'")))


def runtime_imports(tree):
    """Modules that a file imports, without those for types alone."""
    aside = {
        inner
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node not in aside:
            yield node.module or ""
        if isinstance(node, ast.Import) and node not in aside:
            yield from (name.name for name in node.names)


def test_no_other_display_exists():
    """Bars come from `progress` alone, and each class that keeps one is tried above."""
    owners, importers = set(), set()
    for file in Path(console.__file__).parents[1].rglob("*.py"):
        tree = ast.parse(file.read_text(encoding="utf-8"))
        if any(
            name.startswith(("rich.progress", "rich.live", "rich.status", "tqdm")) for name in runtime_imports(tree)
        ):
            importers.add(file.name)
        owners |= {
            node.name for node in ast.walk(tree) if isinstance(node, ast.ClassDef) and "add_task(" in ast.unparse(node)
        }
    assert importers == {"console.py"}
    assert owners == set(USERS) - {"StageDisplay", "log", "search", "free_run_steps", "training_steps"}
    with progress() as shown:
        assert isinstance(shown, BoundedProgress)
