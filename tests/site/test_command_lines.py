"""Every command line of the docs runs, on small things: what a page shows works, not only exists.

Lines of the same form, which differ in names only, run once. What cannot run is listed with its reason.
"""

from __future__ import annotations

import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
from contextlib import chdir
from pathlib import Path

import pytest
from line_grounds import SHORTER, WRITTEN, Ground, Line, edp, kind_of, lines_of, more_of
from rich.table import Table

from edp.cli import console
from edp_site import commands, markdown, notebooks

ROOT = Path(__file__).parents[2]
FOLDERS = (
    ROOT,
    *(ROOT / "docs" / name for name in ("", "explanation", "howto", "reference", "tutorials")),
    ROOT / "website" / "pages",
)
PAGES = [page for folder in FOLDERS for page in sorted(folder.glob("*.md")) if page.name != "CHANGELOG.md"]
LEFT_OUT = {
    "edp live runs/m22 --ros2": "needs ROS 2; tests/unit/live/test_live_sources.py has a stand-in",
    "edp data store build s3://fleet/logs --map mine.toml --out store": (
        "needs a bucket; tests/unit/test_store_buckets.py"
    ),
    "edp train s3://fleet/stores/first --out runs/first": "needs a bucket; tests/unit/test_store_buckets.py",
    "edp search /shared/logs --out studies/first --preset standard --cluster HOST:6379": (
        "needs a cluster; tests/unit/search/test_cluster.py"
    ),
    "edp calibrate LOGS --out MACHINE.toml": "fits a machine; tests/unit/cli/test_cli_identify.py",
    "edp calibrate logs --out mine.toml --machine measured.toml": "fits a machine; tests/unit/cli/test_cli_identify.py",
    "edp adapt replay runs/first_adapted logs/monday --twin runs/grey": (
        "needs a grey box of the network's velocities; tests/unit/test_adaptation.py runs it on one"
    ),
    "edp calibrate logs --out mine.toml --run runs/grey": "fits a machine; tests/unit/cli/test_cli_identify.py",
    "edp train logs --focus simulation --set twin.kind=greybox --set twin.linkage=mine.toml --out runs/grey": (
        "fits a grey box; tests/unit/twin/test_grey_linkage.py"
    ),
    "edp train data/m22 --focus simulation --set twin.kind=greybox --set twin.linkage=mine.toml --out runs/grey": (
        "fits a grey box; tests/unit/twin/test_grey_linkage.py"
    ),
    "edp export runs/first_adapted --format follower --twin runs/grey --out firmware/follower": (
        "needs a grey box of the network's velocities; tests/unit/test_adaptation.py runs it on one"
    ),
}
"""Lines that need what no test has, or fits that take minutes and that other tests run shortened, and why."""
SHELL_LEFT_OUT = {
    "make": "installs packages, or is the run of these tests",
    "source": "is of an environment that this process has",
    "pip": "asks a package registry",
    "python": "examples/mpc.py runs in tests/examples, the parts of a ROS package in tests/export",
    "ray": "needs a cluster",
    "export": "names its keys",
    "colcon": "needs ROS 2",
    "ros2": "needs ROS 2",
}
"""First words of lines of other programs that are not run, and why; targets of make: tests/unit/test_code_blocks.py."""
LIVE_S = 240.0
"""After which a session that says no address, or does not end, is killed: its code is then no success."""
MAX_LEFT_OUT = 11
QUICK = re.compile(
    r"(init|data (check|add-forecasts|store)|evaluate|report|compare|adapt|compress estimate|runs|registry|rollout)"
    r"|monitor r"
)
"""Commands that take fractions of a second."""
ALLOWED = {
    "data check": (0, 3),
    "evaluate": (0, 6),
    "train finetune": (0, 6),
    "twin": (0, 6),
    "calibrate": (0, 6),
    "monitor run": (0, 5),
}
"""Exit codes that say something of the data or the model."""


def form_of(line: Line) -> tuple[object, ...]:
    """What two lines have in common that differ in names only."""
    words: list[str] = []
    for role, word in zip(line.roles, line.words):
        if role == "--name" or word == "--name":
            continue
        free = role in WRITTEN and role not in ("--format", "--set")
        words.append(kind_of(line, role, word) or SHORTER.get((line.command, role)) or ("OUT" if free else word))
    return (line.command, *words, *more_of(line))


ALL = [line for page in PAGES for line in lines_of(page)]
FORMS: dict[tuple[object, ...], Line] = {}
for line in ALL:
    if line.text not in LEFT_OUT:
        FORMS.setdefault(form_of(line), line)
CASES = [
    pytest.param(
        line,
        id=f"{line.page}-{line.number}",
        marks=() if QUICK.match(line.command) else (pytest.mark.slow, pytest.mark.timeout(1200)),
    )
    for line in FORMS.values()
]


@pytest.fixture(scope="module")
def ground(tmp_path_factory) -> Ground:
    return Ground(tmp_path_factory.mktemp("ground"))


@pytest.fixture
def tables(monkeypatch) -> list[list[str]]:
    """Tables that commands print at 80 columns, as their lines."""
    printed: list[list[str]] = []
    plain = console.Terminal.print

    def keeping(self, *objects, **options):
        for part in objects:
            if isinstance(part, Table):
                rendered = self.render_lines(part, self.options.update(width=80))
                printed.append(["".join(segment.text for segment in row).rstrip() for row in rendered])
        plain(self, *objects, **options)

    monkeypatch.setattr(console.Terminal, "print", keeping)
    monkeypatch.setattr(console.out, "_width", 80)
    return printed


def blocks_of(page: Path) -> str:
    """Return the code blocks of a page, or the command cells of a notebook as blocks."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = [notebooks.command_lines(notebooks.source_of(cell)) for cell in json.loads(text)["cells"]]
        return "\n".join(f"```sh\n{chr(10).join(lines)}\n```" for lines in cells if lines)
    return "\n".join(f"```{one.language}\n{one.code}\n```" for one in markdown.fences(text))


@pytest.mark.parametrize("page", [*PAGES, *sorted((ROOT / "docs" / "tutorials").glob("*.ipynb"))], ids=lambda p: p.stem)
def test_every_command_line_of_a_block_is_parsed_by_the_command_line(page):
    problems = []
    for number, text in commands.command_lines(blocks_of(page)):
        words = shlex.split(commands.ENDS.split(f"{text} ")[0], comments=True)[1:]
        named: tuple[str, ...] = ()
        while words and (*named, words[0]) in commands.commands():
            named = (*named, words.pop(0))
        if words and (*named, "run") in commands.commands():
            named = (*named, "run")
        parsed = commands.commands()[named].parsed
        if hasattr(parsed, "commands"):
            assert not words or words[0].startswith("-"), text
            continue
        try:
            parsed.make_context(named[-1], list(words))
        except Exception as error:  # of the parser's own library, whose classes are not public
            if type(error).__name__ != "Exit":
                problems.append(f"line {number}: {text}: {getattr(error, 'message', error)}")
    assert problems == []


@pytest.mark.long
@pytest.mark.parametrize("line", CASES)
@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_command_line_of_the_docs_runs(line, ground, tables, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("TERM", "dumb")
    words = [*line.command.split(), *ground.lay(line, tmp_path)]
    capsys.readouterr()
    if line.command == "live" and "--log" not in line.words:
        code, said = live(words, tmp_path)
    else:
        with chdir(tmp_path):
            code = edp(*words)
        said = "".join(capsys.readouterr())
    assert code in ALLOWED.get(line.command, (0,)), f"{line.text}: {said[-2000:]}"
    for table in tables:
        # Rows that are cut read alike: six of a table were once all 'CylPress...'.
        assert all(len(row) <= 80 for row in table), table
        assert not any("…" in row for row in table), table


def live(words: list[str], folder: Path) -> tuple[int, str]:
    """A session without an end, in a process: stopped by Ctrl-C once its page has an address."""
    places = os.pathsep.join(place for place in sys.path if place)
    session = subprocess.Popen(
        [sys.executable, "-u", "-m", "edp", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": places},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        # A shell that starts tests in the background has them ignore Ctrl-C, and so would the session.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    too_late = threading.Timer(LIVE_S, session.kill)
    too_late.start()
    with session as process:
        try:
            said = ""
            for text in process.stdout or ():
                said += text
                if "Ctrl-C ends" in text:
                    process.send_signal(signal.SIGINT)
            return process.wait(), said
        finally:
            too_late.cancel()
            process.kill()


def test_what_is_left_out_is_on_a_page_and_has_a_reason_that_is_there_and_does_not_grow():
    for reason in LEFT_OUT.values():
        assert all((ROOT / name).is_file() for name in re.findall(r"tests/\S+\.py", reason)), reason
    assert set(LEFT_OUT) <= {line.text for line in ALL}
    assert len(LEFT_OUT) <= MAX_LEFT_OUT, "run the line, or raise the number in a review"


def other_lines() -> dict[str, list[str]]:
    """Lines of other programs in blocks of a shell, by their first word."""
    found: dict[str, list[str]] = {}
    for page in PAGES:
        for fence in markdown.fences(page.read_text(encoding="utf-8")):
            for text in fence.code.splitlines() if fence.language in ("", "sh") else ():
                words = text.split("#")[0].split()
                known = words and (fence.language == "sh" or words[0] in {*SHELL_LEFT_OUT, "cmake"})
                if known and re.fullmatch(r"[a-z0-9]+", words[0]) and words[0] != "edp":
                    found.setdefault(words[0], []).append(" ".join(words))
    return found


def test_lines_of_other_programs_are_run_or_left_out_by_name():
    assert set(other_lines()) == {*SHELL_LEFT_OUT, "cmake"}


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("text", sorted(set(other_lines()["cmake"])))
def test_exported_code_is_built_and_tested_by_the_lines_of_the_docs(text, ground, tmp_path):
    if not (shutil.which("cmake") and shutil.which("cc")):
        pytest.skip("no cmake, or no C compiler")
    (folder,) = set(re.findall(r"-S (\S+)", text))
    kind = {"firmware/control": "loop", "firmware/monitor": "monitor"}.get(folder, "run")
    form = "controller" if kind == "loop" else "c"
    assert edp("export", ground.of(kind), "--format", form, "--out", tmp_path / folder) == 0
    done = subprocess.run(text, shell=True, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    assert "100% tests passed" in done.stdout
