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
from edp.workflows.api.recordings import read

ONE_LOG = {
    ("rollout", "log"): "one log is run along",
    ("live", "log"): "one log is played",
}
"""Parameters of one path, each with the reason; any other parameter of logs takes several."""
LOGS = {"data", "logs", "log", "arguments", "paths", "further", "w8a16"}


def _commands(group, path=()):
    for name, command in sorted(group.commands.items()):
        here = (*path, name)
        if hasattr(command, "commands"):
            yield from _commands(command, here)
        else:
            yield here, command.params


EVERY = dict(_commands(typer.main.get_command(app)))


def _takes_several(parameter):
    return parameter.nargs == -1 or getattr(parameter, "multiple", False)


def test_every_argument_and_option_of_logs_takes_several_paths():
    several = {
        (*command, parameter.name): _takes_several(parameter)
        for command, parameters in EVERY.items()
        for parameter in parameters
        if parameter.name in LOGS
    }
    assert len(several) >= 20
    one = {where for where, many in several.items() if not many}
    assert one == set(ONE_LOG)


def test_every_command_with_a_map_takes_several_logs():
    """A later command may name its logs otherwise, but a map belongs to logs."""
    for command, parameters in EVERY.items():
        names = {parameter.name for parameter in parameters}
        if "signal_map" in names and not any((*command, name) in ONE_LOG for name in names):
            several = [parameter.name for parameter in parameters if _takes_several(parameter)]
            assert set(several) & LOGS, (command, several)


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
    result = CliRunner().invoke(app, ["data", "check", *chosen, "--json", "--no-coverage"])
    assert result.exit_code == 0, result.output
    assert len(json.loads(result.stdout)["recordings"]) == 3


def test_a_source_of_several_paths_is_read_and_found_again(logs):
    source = DataSource.from_path([logs / "a", logs / "b" / "three.csv", logs / "a" / "one.csv"])
    assert [log.path.stem for log in source.logs()] == ["one", "two", "three"]
    assert [recording.name for recording in source.read()] == ["one", "two", "three"]
    again = DataSource.from_dict(json.loads(json.dumps(source.to_dict())))
    assert [recording.digest for recording in again.read()] == [recording.digest for recording in source.read()]
    assert source.label.endswith("a and 2 more")


def test_a_data_set_file_or_a_store_comes_alone(logs):
    (logs / "set.toml").write_text('[[recordings]]\npath = "a/one.csv"\n')
    with pytest.raises(ConfigError, match=r"set.toml' came with 1 other path.*alone"):
        DataSource.from_path([logs / "a", logs / "set.toml"])
    with pytest.raises(ConfigError, match="came with 1 other path"):
        DataSource.from_path([Path("s3://bucket/logs"), logs / "a"])


def test_an_empty_list_of_paths_is_refused():
    with pytest.raises(ConfigError, match="got an empty list of paths"):
        DataSource.from_path([])
    with pytest.raises(ConfigError, match="got an empty list of paths"):
        read([])


def test_recordings_of_several_paths_are_read_in_python(logs):
    together = read([logs / "a", str(logs / "b" / "three.csv")])
    assert together.recording_names == ("one", "two", "three")
    assert together.source.paths == (logs / "a", logs / "b" / "three.csv")


def test_all_paths_count_in_the_name_of_a_source(logs):
    a, b = logs / "a", logs / "b"
    assert DataSource.from_path(a / "one.csv").short_name == "one"
    assert DataSource.from_path([a, b]).short_name.startswith("a_and_1_more_")
    names = [DataSource.from_path(paths).short_name for paths in (a, [a, b], [a, b / "three.csv"], [a / "one.csv", b])]
    assert len(set(names)) == len(names)
    assert DataSource.from_path([a, b]).short_name[1:] == DataSource.from_path([b, a]).short_name[1:]
    assert len(DataSource.from_path(logs / ("n" * 200)).short_name) < 150


def test_a_map_is_proposed_for_several_logs(logs):
    chosen = [str(logs / "a" / "one.csv"), str(logs / "b")]
    result = CliRunner().invoke(app, ["init", *chosen, "--out", str(logs / "described"), "--yes", "--json"])
    assert result.exit_code == 0, result.output
    found = json.loads(result.stdout)
    assert [Path(path).stem for path in found["logs"]] == ["one", "three"]
    assert all(path in command for path in chosen for command in found["next"][:2])
