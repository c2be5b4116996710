"""The commands of the tutorial run one after the other on the recording that it names."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from edp_site import markdown

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "tutorial.md").read_text(encoding="utf-8")
SHARED = Path(os.environ.get("EDP_SHARED_DATA", ROOT.parent / "shared" / "data"))
RECORDING = SHARED / "fatigue_rig_faster" / "faster.csv"


def commands_behind(heading: str, until: str = "## Where to go on") -> list[list[str]]:
    """The `edp` calls of the tutorial between two headings, as words."""
    lines = [
        line
        for fence in markdown.fences(PAGE.split(heading)[1].split(until)[0])
        if fence.language == "sh"
        for line in fence.code.splitlines()
    ]
    return [shlex.split(line, comments=True)[1:] for line in lines if line.startswith("edp ")]


def run(words: list[str], folder: Path, allowed: tuple[int, ...] = (0,)) -> str:
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    call = [sys.executable, "-m", "edp", *words]
    done = subprocess.run(call, cwd=folder, env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode in allowed, f"edp {shlex.join(words)}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
    return done.stdout + done.stderr


@pytest.mark.slow
@pytest.mark.shared_data
@pytest.mark.timeout(3600)
def test_the_tutorial_runs_on_its_recording(tmp_path):
    if not RECORDING.exists():
        pytest.skip(
            f"the recording of the tutorial is not here: {RECORDING}; EDP_SHARED_DATA names its folder's parent"
        )
    (tmp_path / "logs").mkdir()
    shutil.copy(RECORDING, tmp_path / "logs")
    shown = next(fence.code for fence in markdown.fences(PAGE) if fence.language == "text")
    change = next(fence.code for fence in markdown.fences(PAGE) if fence.language == "toml")
    commands = commands_behind("## 2.")
    assert [words[0] for words in commands] == [
        "init", "inspect", "train", "evaluate", "report", "footprint", "distil", "evaluate", "export",
    ]  # fmt: skip
    for words in commands:
        # A tenth of the budget: the way is tested here, not the errors. A baseline may then be better (exit code 6).
        short = ["0.1" if before == "--minutes" else word for before, word in zip(["", *words], words)]
        said = run(short, tmp_path, (0, 6) if words[0] == "evaluate" else (0,))
        if words[0] == "init":
            cells = [line.split()[:4] for line in shown.splitlines()]
            assert [line for line in cells if line not in [row.split()[:4] for row in said.splitlines()]] == []
            path = tmp_path / "map.toml"
            text = path.read_text(encoding="utf-8")
            old = '[channels.d]\ncolumn = "d"\nkind = "generic"\nunit = "1"\n'
            assert old in text
            path.write_text(text.replace(old, change), encoding="utf-8")
    assert (tmp_path / "runs" / "first" / "report.html").is_file()
    assert (tmp_path / "firmware" / "rig.h").is_file()


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_tutorial_runs_on_simulated_recordings_without_a_map(tmp_path):
    (simulate,) = [words for words in commands_behind("## 1.") if words[0] == "simulate"]
    run([{"20": "4", "10": "4"}.get(word, word) for word in simulate], tmp_path)
    for words in commands_behind("## 3.", "## 6."):
        plain = [word for before, word in zip(["", *words], words) if not {word, before} & {"--map", "--config"}]
        short = ["0.1" if before == "--minutes" else word for before, word in zip(["", *plain], plain)]
        run(short, tmp_path, (0, 6) if words[0] == "evaluate" else (0,))
    assert (tmp_path / "runs" / "first" / "report.html").is_file()
