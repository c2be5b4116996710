"""Names from files and command lines in the terminal: nothing in them is markup, and nothing moves the cursor."""

import ast
import io
import os
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import edp.cli
from edp.cli import app, console
from edp.cli.console import Steps, Terminal, listing, progress, run_app, table, visible
from edp.errors import ConfigError

HOSTILE = [
    "[/b].csv",
    "a[/bold]b",
    "[red]x[/]",
    r"a\[/b]",
    "[/]",
    "[link=http://a.b]c[/link]",
    "\x1b[2J\x1b[H",
    "\x9b2J",
    "\x07\x08\r",
    "line\nnext: rm -rf",
    "\u202egnp.exe",
    "a\u2066b\u2069\u200f",
    ":smile:",
    os.fsdecode(b"caf\xe9.csv"),
    "\ud800",
    "tab\there",
    "\x00",
]
FORBIDDEN = {chr(c) for c in (*range(32), *range(127, 160), 0x202E, 0x2066, 0x2067, 0x2068, 0x202A, 0x200F)} - {"\n"}


@pytest.fixture
def screen(monkeypatch):
    """Standard output and error as bytes of UTF-8, and how often a line ends."""
    streams = types.SimpleNamespace(out=io.StringIO(), err=io.StringIO())
    for name, stream in (("out", streams.out), ("err", streams.err)):
        made = Terminal(stderr=name == "err")
        made.file = stream
        monkeypatch.setattr(console, name, made)
    return streams


def shows(text, *names):
    """The text holds no control character, can be written as UTF-8, and has every name as it is made visible."""
    assert not FORBIDDEN & set(text), text
    text.encode("utf-8")
    flat = "".join(text.split())
    for name in names:
        assert "".join(visible(name).split()) in flat


@pytest.mark.parametrize("name", HOSTILE)
def test_every_way_out_shows_names_as_they_are(name, screen):
    console.out.print(f"file {name}: read")
    console.out.print(name, style="bold")
    console.err.print(name)
    table(name, ["name", name], [[name, name], ["number", 5]])
    listing(name, ["name", name], [[name, name]])
    Steps(quiet=False, every_s=0.0).say(name, force=True)
    shows(screen.out.getvalue(), name)
    shows(screen.err.getvalue(), name)
    assert "next: rm" not in [line.strip() for line in screen.out.getvalue().splitlines()]


@pytest.mark.parametrize("name", HOSTILE)
def test_errors_and_progress_show_names_as_they_are(name, screen, monkeypatch):
    def fail(standalone_mode):
        raise ConfigError(f"settings '{name}': 1 problem\n  - unknown key '{name}'")

    assert run_app(fail) == 1
    shows(screen.err.getvalue(), name)
    assert len(screen.err.getvalue().splitlines()) == 2
    made = Terminal(stderr=True)
    made.file, made._force_terminal = io.StringIO(), True
    monkeypatch.setattr(console, "err", made)
    with progress() as shown:
        task = shown.add_task(name, total=1.0, note=name)
        shown.update(task, completed=0.5, note=f"{name}, 1 of 2")
        words = [column.render(shown.tasks[0]).plain for column in shown.columns if hasattr(column, "of_task")]
    assert len(words) == 2
    for text in words:
        shows(text, name)


@given(st.text(st.characters(codec=None)))
def test_whatever_comes_is_printable_and_told_apart(text):
    shown = visible(text)
    assert not FORBIDDEN & set(shown)
    assert "\n" not in shown
    shown.encode("utf-8")
    if all(c.isprintable() for c in text):
        assert shown == text


def run(monkeypatch, capsys, *args):
    monkeypatch.setattr(sys, "argv", ["edp", *map(str, args)])
    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setenv("TERM", "dumb")
    code = run_app(app)
    text = capsys.readouterr()
    return code, text.out, text.err


LOG = "time,a[/bold]b,v\n" + "".join(f"{i / 100:.2f},{np.sin(i / 9):.4f},{i % 7}\n" for i in range(300))


@pytest.mark.parametrize("name", ["[/b].csv", "x\x1b[2J.csv", os.fsdecode(b"\xff[/i].csv")])
def test_inspect_of_a_file_of_a_hostile_name(name, tmp_path, monkeypatch, capsys):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(LOG)
    code, out, err = run(monkeypatch, capsys, "data", "check", path, "--no-coverage")
    shows(out)
    shows(err)
    if name.isprintable():
        assert code in (0, 3), err
        shows(out, "a[/bold]b")
    assert "Traceback" not in err


@pytest.mark.parametrize(
    "args",
    [
        ["data", "check", "missing a[/b]"],
        ["train", "missing [/b]", "--out", "x[/b]", "--set", r"a\[/b]=1"],
        ["train", "d", "--out", "x", "--set", r"a\[/b]=1"],
        ["train", "d", "--out", "x", "--preset", "[/b]"],
        ["train", "d", "--out", "x", "--config", "[/b]\x1b[2J.toml"],
        ["evaluate", "\x1b]0;title\x07[/b]"],
        ["compress", "estimate", "[/b].toml"],
        ["data", "screen", "[/b]", "--out", "x"],
        ["nonsense[/b]\x1b[2J"],
        ["train", "d", "--nonsense[/b]\x1b[2J"],
        ["compress", "distil", "d", "--units", "[/b]\x1b[2J", "--out", "x"],
    ],
)
def test_command_lines_of_hostile_words(args, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, out, err = run(monkeypatch, capsys, *args)
    assert code in (1, 2)
    shows(out)
    shows(err)
    assert "error: " in err


def test_a_budget_of_a_hostile_name(tmp_path, monkeypatch, capsys):
    budget = tmp_path / "b.toml"
    budget.write_text('name = "[/b] \\u001b[2J"\n')
    settings = tmp_path / "net.toml"
    settings.write_text("[model]\nwindow = 20\n")
    code, out, err = run(monkeypatch, capsys, "compress", "estimate", settings, "--budget", budget)
    assert code == 0, err
    shows(out, "[/b] \x1b[2J")


def test_json_is_exact(screen, capsys):
    console.emit(True, {"name": "\x1b[2J", "file": os.fsdecode(b"\xff")}, lambda: None)
    text = capsys.readouterr().out
    assert text.isascii()
    assert "\x1b" not in text


def test_no_command_writes_past_the_console():
    """Modules of the command line print through `out`, `err` and the tables of the console, and nothing else."""
    for path in Path(edp.cli.__file__).parent.glob("*.py"):
        if path.name == "console.py":
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            where = f"{path.name}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Call):
                called = ast.unparse(node.func)
                assert called not in ("print", "sys.stdout.write", "sys.stderr.write"), where
                assert called not in ("typer.secho", "click.echo", "Text.from_markup", "Console"), where
                if called == "typer.echo":
                    assert ast.unparse(node.args[0]) == "__version__", where
                assert not [word for word in node.keywords if word.arg in ("markup", "emoji", "highlight")], where
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("rich"):
                assert node.module == "rich.progress", where
                assert {name.name for name in node.names} <= {"Progress", "TaskID"}, where
