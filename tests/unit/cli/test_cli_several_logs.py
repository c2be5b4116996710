"""Commands that take logs take several files and folders."""

import json
from pathlib import Path

import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from edp.cli import app
from edp.errors import ConfigError
from edp.logs.source import DataSource

ONE_LOG = {
    ("rollout", "log"): "one log is run along",
    ("init", "logs"): "one log or folder is described, whose path the proposed commands repeat",
    ("search", "run", "data"): "a study belongs to one folder",
}
"""Arguments of one path, each with the reason; any other argument of logs takes several."""
LOGS = {"data", "logs", "log", "recordings"}


def _arguments(group, path=()):
    for name, command in sorted(group.commands.items()):
        here = (*path, name)
        if hasattr(command, "commands"):
            yield from _arguments(command, here)
            continue
        for parameter in command.params:
            if parameter.param_type_name == "argument" and parameter.name in LOGS:
                yield (*here, parameter.name), parameter


def test_every_argument_of_logs_takes_several_paths():
    several = {where: parameter.nargs == -1 for where, parameter in _arguments(typer.main.get_command(app))}
    assert len(several) >= 10
    one = {where for where, many in several.items() if not many}
    assert one == set(ONE_LOG)


@pytest.fixture
def logs(tmp_path):
    rng = np.random.default_rng(0)
    for name in ("a/one", "a/two", "b/three"):
        path = tmp_path / f"{name}.csv"
        path.parent.mkdir(exist_ok=True)
        rows = "".join(f"{k / 100},{rng.normal():.4f}\n" for k in range(200))
        path.write_text(f"time_s,CylVels_1\n{rows}", encoding="utf-8")
    return tmp_path


def test_a_folder_and_files_are_inspected_together_and_each_log_once(logs):
    chosen = [str(logs / "a"), str(logs / "b" / "three.csv"), str(logs / "a" / "one.csv")]
    result = CliRunner().invoke(app, ["inspect", *chosen, "--json", "--no-coverage"])
    assert result.exit_code == 0, result.output
    assert len(json.loads(result.stdout)["recordings"]) == 3


def test_a_source_of_several_paths_is_read_and_found_again(logs):
    source = DataSource.of([logs / "a", logs / "b" / "three.csv", logs / "a" / "one.csv"])
    assert [log.path.stem for log in source.logs()] == ["one", "two", "three"]
    assert [recording.name for recording in source.read()] == ["one", "two", "three"]
    again = DataSource.from_plain(json.loads(json.dumps(source.to_plain())))
    assert [recording.digest for recording in again.read()] == [recording.digest for recording in source.read()]
    assert source.label.endswith("a and 2 more")


def test_a_data_set_file_or_a_store_comes_alone(logs):
    (logs / "set.toml").write_text('[[recordings]]\npath = "a/one.csv"\n')
    with pytest.raises(ConfigError, match=r"set.toml' came with 1 other path.*alone"):
        DataSource.of([logs / "a", logs / "set.toml"])
    with pytest.raises(ConfigError, match="came with 1 other path"):
        DataSource.of([Path("s3://bucket/logs"), logs / "a"])
