"""The files and commands of ``edp init`` as a user follows them, on a rig that EDP knows nothing of."""

import shlex
from pathlib import Path

import numpy as np
import pytest

COMMANDS = {
    "data check": (),
    "train": ("--preset", "quick", "--set", "training.epochs=1", "--set", "training.updates=3"),
    "evaluate": ("--baselines", "none"),
    "report": (),
    "twin": ("--set", "twin.kind=arx", "--set", "evaluation={duration_s=4,starts=2,at_s=[1,4]}"),
}
"""What shortens a command that `edp init` prints; every printed command has an entry."""
SEARCH = (
    *("--phase", "isolation", "--workers", 1, "--set", 'search.backbones=["lstm"]', "--set", "search.updates=2"),
    *("--set", "search.isolation.seeds=2", "--set", "model.backbone.units=4", "--set", "search.space.units=[4, 6]"),
)


def write_rig(folder: Path, logs: int, seconds: float, rate_hz: float) -> Path:
    """Write logs of a cylinder: valve command, position, velocity, two pressures, in the logger's own names."""
    folder.mkdir()
    for number in range(logs):
        rng = np.random.default_rng(number)
        count, tick = round(seconds * rate_hz), 1 / rate_hz
        command = np.repeat(rng.uniform(-10, 10, count // 40 + 1), 40)[:count]
        velocity, position = np.zeros(count), np.full(count, 250.0)
        for i in range(1, count):
            velocity[i] = velocity[i - 1] + (15 * command[i - 1] - velocity[i - 1]) * tick / 0.1
            position[i] = np.clip(position[i - 1] + velocity[i] * tick, 5, 495)
        columns = (
            np.arange(count) * tick,
            command,
            position + rng.normal(0, 0.02, count),
            velocity + rng.normal(0, 0.5, count),
            60 + 0.3 * velocity + rng.normal(0, 0.2, count),
            50 - 0.2 * velocity + rng.normal(0, 0.2, count),
        )
        lines = [",".join(f"{value:.4f}" for value in row) for row in zip(*columns, strict=True)]
        head = "time_s,valve_command_V,position_mm,velocity_mm_s,pressure_A_bar,pressure_B_bar"
        (folder / f"run_{number}.csv").write_text("\n".join([head, *lines]) + "\n")
    return folder


@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("logs", "seconds", "rate_hz"),
    [
        pytest.param(1, 60, 50, id="one log at 50 Hz"),
        pytest.param(6, 30, 100, id="six logs", marks=pytest.mark.slow),
        pytest.param(3, 60, 100, id="three logs", marks=pytest.mark.slow),
    ],
)
def test_every_command_that_init_prints_and_a_search_run_on_its_files(edp, tmp_path, logs, seconds, rate_hz):
    data = write_rig(tmp_path / "logs", logs, seconds, rate_hz)
    printed = edp("init", data, "--yes", "--out", tmp_path / "out", "--json").json
    commands = [*printed["next"], printed["plant_command"]]
    assert len(commands) == len(COMMANDS)
    for command in commands:
        words = shlex.split(command)[1:]
        ended = edp(*words, *COMMANDS[" ".join(words[:2]) if words[0] == "data" else words[0]])
        assert ended.code in (0, 6), ended.err
    files = ("--map", tmp_path / "out/map.toml", "--config", tmp_path / "out/settings.toml")
    found = edp("search", data, *files, "--study", tmp_path / "study", *SEARCH, "--json")
    assert found.code == 0, found.err
    assert found.json["decisions"][0]["facts"]["features"] == "proposed"
    assert edp("data", "screen", data, *files, "--out", tmp_path / "screen", "--no-pictures").code == 0
    sessions = tmp_path / "study/sessions.toml"
    assert sessions.exists() == (logs < 5)
    if sessions.exists():
        parts = ("--out", tmp_path / "parts", "--set", "split.kind=recordings")
        assert edp("train", sessions, *files[2:], *parts, *COMMANDS["train"]).code == 0


def test_logs_too_short_to_divide_are_refused_with_what_is_needed(edp, tmp_path):
    data = write_rig(tmp_path / "logs", 1, 12, 100)
    assert edp("init", data, "--yes", "--out", tmp_path).code == 0
    files = ("--map", tmp_path / "map.toml", "--config", tmp_path / "settings.toml")
    refused = edp("search", data, *files, "--study", tmp_path / "study", *SEARCH)
    assert refused.code == 1
    assert "too short (or in a store) to be divided" in refused.err
    assert not (tmp_path / "study").exists()
