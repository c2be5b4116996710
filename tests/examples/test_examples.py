"""What the README and the examples show is run as it stands there."""

import dataclasses
import re
import runpy
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edp.cli import app
from edp.cli.console import run_app
from edp.config.experiment import load_experiment
from edp.evaluation.controller import Budget
from edp.logs import write_recording
from edp.logs.source import load_data_set, load_signal_map
from edp.recording import Recording
from edp.signals import TABLE_A1
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.workflows.search.context import SearchContext
from edp.workflows.search.phases import PHASES
from edp.workflows.search.plan import load_plan

ROOT = Path(__file__).parents[2]
EXAMPLES = ROOT / "examples"
OTHER = {"leagues.toml"}  # figures to compare with, read by a benchmark
SETTINGS = sorted(path for path in EXAMPLES.rglob("*.toml") if path.name not in OTHER and path.parent.name != "budgets")
SMALL = (
    "training.epochs=1",
    "training.updates=3",
    'training.optimizer={kind="adamw"}',
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    'model.backbone={kind="hybrid",channels=[4],kernel=3,units=4}',
    "model.window=12",
    "evaluation.history=5",
)


def loader_of(path: Path) -> Callable[[Path], object]:
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    if path.parent.name == "scenarios":
        return SimulationOrder.from_scenario
    if "search" in table:
        return load_plan
    return load_data_set if "recordings" in table else load_signal_map if "channels" in table else load_experiment


def test_there_are_examples():
    assert len(SETTINGS) >= 10
    assert {loader_of(path) for path in SETTINGS} == {
        load_signal_map,
        load_data_set,
        load_experiment,
        SimulationOrder.from_scenario,
        load_plan,
    }


@pytest.mark.parametrize("path", SETTINGS, ids=lambda path: str(path.relative_to(EXAMPLES)))
def test_settings_load(path):
    assert loader_of(path)(path) is not None


@pytest.mark.parametrize(("stem", "name"), [("map_columns", "map.toml"), ("choose_preset", "rig.toml")])
def test_a_page_shows_a_file_of_the_examples(stem, name):
    page = ROOT / "docs" / "howto" / f"{stem}.md"
    shown = re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    assert (EXAMPLES / name).read_text(encoding="utf-8") in shown, f"{page.name} and examples/{name} differ"


def test_the_readme_is_short_and_its_table_of_commands_is_whole():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) < 120
    page = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
    from edp.cli import app

    names = [str(c.name) for c in app.registered_commands] + [str(group.name) for group in app.registered_groups]
    assert [name for name in names if f"`edp {name}" not in page] == []


def test_links_of_the_documents_lead_somewhere():
    pages = [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]
    for page in pages:
        for target in re.findall(r"\]\(([^)#]+)", page.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (page.parent / target).exists(), f"{page.name}: {target}"


def test_rows_of_tables_stand_in_tables():
    """A row behind a paragraph is shown as text with bars."""
    for page in [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]:
        text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        for block in re.split(r"\n[ \t]*\n", text):
            lines = block.strip("\n").splitlines()
            if any(line.startswith("| ") for line in lines):
                assert lines[0].startswith("|"), f"{page.name}: {lines[0]}"
                assert re.fullmatch(r"\|[-:| ]+\|", lines[1]), f"{page.name}: {lines[1]}"


def test_compression_page_names_every_option_and_shows_the_budget_of_the_examples():
    page = (ROOT / "docs" / "howto" / "fit_budget.md").read_text(encoding="utf-8")
    table = page.split("| Key | Default | Meaning |")[1].split("\n\n")[0]
    shown = re.findall(r"^\| `(\w+)` \| (.+?) \|", table, re.MULTILINE)
    entries = dataclasses.fields(Budget)
    assert [name for name, _ in shown] == [entry.name for entry in entries]
    for (name, text), entry in zip(shown, entries):
        if name != "name":
            assert text.strip("`") == str(entry.default).removesuffix(".0"), name
    (example,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    whole = (EXAMPLES / "budgets" / "small_controller.toml").read_text(encoding="utf-8")
    assert whole.endswith(example)


def test_search_page_names_every_phase_and_shows_the_examples():
    page = (ROOT / "docs" / "howto" / "run_search.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (`.+?) \|", page, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert [name for name in named if name in PHASES] == list(PHASES)
    assert (EXAMPLES / "search.toml").read_text(encoding="utf-8") in page
    whole = (EXAMPLES / "search.py").read_text(encoding="utf-8")
    (shown,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    for line in shown.strip().splitlines():
        assert line.strip() in whole, line


@pytest.mark.parametrize("preset", ["quick", "standard", "thesis"])
def test_search_page_tells_how_much_a_preset_trains(preset):
    page = (ROOT / "docs" / "howto" / "run_search.md").read_text(encoding="utf-8")
    spec = load_plan(preset=preset).spec
    ground = SearchContext(spec, {}, {}, tuple(f"session {i}" for i in range(20)), ())
    trainings = sum(phase.trainings(ground) for phase in PHASES.values())
    assert f"| `{preset}` | {trainings:,} | " in page


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_quick_search_on_simulated_recordings(tmp_path, capsys):
    simulate_data_set(tmp_path / "data", SimulationOrder(minutes=20.0, recordings=20))
    script = runpy.run_path(str(EXAMPLES / "search.py"))
    script["main"](str(tmp_path / "data"), str(tmp_path / "study"))
    printed = capsys.readouterr().out
    assert all(f"{name}\n" in printed for name in PHASES)
    load_experiment(tmp_path / "study" / "teacher.toml", "quick")


def test_quickstart(tmp_path, capsys):
    rng = np.random.default_rng(4)
    scale = np.array([0.2 if channel.unit == "m/s" else 1e6 for channel in TABLE_A1.values()])
    for i in range(4):
        walk = np.cumsum(rng.normal(size=(400, 24)), axis=0) * 0.02 * scale
        recording = Recording(f"drive_{i}", tuple(TABLE_A1.values()), walk.astype(np.float32), 100.0, source="test")
        write_recording(recording, tmp_path / "data" / f"drive_{i}.parquet")
    script = runpy.run_path(str(EXAMPLES / "quickstart.py"))
    changes = {key: tomllib.loads(f"value = {value}")["value"] for key, value in (c.split("=", 1) for c in SMALL)}
    script["main"](str(tmp_path / "data"), str(tmp_path / "run"), changes)
    printed = capsys.readouterr().out
    assert "report.html" in printed
    assert "CylVels_3" in printed


def rig_log(path: Path, seconds: float = 12.0) -> None:
    """A log of the README's test rig: milliseconds, mm/s, bar, percent; one value is missing."""
    rng = np.random.default_rng(1)
    time_s = np.arange(0.0, seconds, 0.01)
    command = 60 * np.sin(1.3 * time_s) + 20 * np.sin(3.1 * time_s)
    speed = 2.5 * command + rng.normal(0, 1, len(time_s))
    lines = ["Zeit;v_cyl;pA;pB;u_valve;remark"]
    for t, v, u in zip(time_s, speed, command, strict=True):
        lines.append(f"{1e3 * t:.0f};{v:.3f};{80 + 0.3 * u:.2f};{60 - 0.2 * u:.2f};{u:.2f};ok")
    lines[500] = lines[500].replace(lines[500].split(";")[1], "", 1)
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


def test_own_logs_as_the_readme_tells(tmp_path, monkeypatch, capsys):
    def edp(*args: object) -> int:
        monkeypatch.setattr(sys, "argv", ["edp", *map(str, args)])
        return run_app(app)

    log, run = tmp_path / "drive.csv", tmp_path / "run"
    rig_log(log)
    mapped = ("--map", EXAMPLES / "map.toml")
    assert edp("data", "check", log, *mapped) == 3  # a missing value
    options = [word for change in SMALL for word in ("--set", change)]
    train = ("train", log, *mapped, "--config", EXAMPLES / "rig.toml", "--preset", "quick", *options, "--out", run)
    assert edp(*train) == 1
    assert "--repair" in capsys.readouterr().err
    assert edp(*train, "--repair", "nan=hold") == 0
    # A training of seconds may lose to a line, which the command then says by its exit code.
    assert edp("evaluate", run, "--baselines", "persistence,ridge_arx") in (0, 6)
    assert edp("report", run) == 0
    assert "velocity" in (run / "report.html").read_text(encoding="utf-8")
