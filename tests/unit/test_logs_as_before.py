"""Further logs without a map are read as those that trained."""

from __future__ import annotations

import os

import pytest

from edp.errors import DataError
from edp.logs import Repair
from edp.logs.as_before import read_as_before
from edp.logs.source import DataSource
from edp.signals import ChannelMap, Kind, SignalMap

pytestmark = pytest.mark.processes

MAP = SignalMap((ChannelMap("boom", "v boom", "mm/s", Kind.VELOCITY),), time="t")
REPAIR = Repair(nan="hold")


def log(path, names="t,v boom,other"):
    path.parent.mkdir(exist_ok=True)
    path.write_text(names + "\n" + "".join(f"{i / 10},{i % 7},{i}\n" for i in range(40)))
    return path


@pytest.fixture
def reader(tmp_path):
    return DataSource(log(tmp_path / "old" / "a.csv").parent, MAP, REPAIR).to_dict()


def test_a_log_with_the_columns_of_the_map_has_it_with_its_repairs(reader, tmp_path):
    source = read_as_before(DataSource(log(tmp_path / "new.csv")), reader)
    assert (source.signal_map, source.repair) == (MAP, REPAIR)
    assert source.read()[0].channel_names == ("boom",)
    own = Repair(gaps="hold")
    assert read_as_before(DataSource(tmp_path / "new.csv", repair=own), reader).repair == own


def test_a_map_that_is_stated_stays(reader, tmp_path):
    other = SignalMap((ChannelMap("other", "other", "1", Kind.GENERIC),), time="t")
    source = DataSource(log(tmp_path / "new.csv"), other)
    assert read_as_before(source, reader) is source


@pytest.mark.parametrize("names", ["t,v arm,other", "time,speed,x"])
def test_other_logs_are_refused_as_before(reader, tmp_path, names):
    source = DataSource(log(tmp_path / "new.csv", names))
    assert read_as_before(source, reader) is source
    with pytest.raises(DataError, match="none is in the built-in vocabulary"):
        source.read()


def test_what_cannot_be_looked_at_is_told_when_it_is_read(reader, tmp_path):
    for path in (tmp_path / "nothing.csv", tmp_path / "empty"):
        source = DataSource(path)
        assert read_as_before(source, reader) is source
    damaged = tmp_path / "damaged.csv"
    damaged.write_bytes(b"\x00\x01" * 400)
    assert read_as_before(DataSource(damaged), reader).signal_map is None
    # The data set that trained may be gone.
    gone = {"path": str(tmp_path / "gone.toml")}
    assert read_as_before(DataSource(log(tmp_path / "new.csv")), gone).signal_map is None
    # A map of constants alone knows no log.
    still = SignalMap((ChannelMap("a", "", "1", Kind.GENERIC, 1.0),), others=True)
    constants = DataSource(tmp_path / "old", still).to_dict()
    assert read_as_before(DataSource(tmp_path / "new.csv"), constants).signal_map is None


@pytest.mark.parametrize("maps", [("map.toml",), ("map.toml", "second.toml")])
def test_of_a_data_set_the_map_that_all_its_logs_have(tmp_path, maps):
    for name, unit in (("map.toml", "mm/s"), ("second.toml", "m/s")):
        (tmp_path / name).write_text(
            f'time = "t"\n[channels.boom]\ncolumn = "v boom"\nkind = "velocity"\nunit = "{unit}"\n'
        )
    entries = []
    for i, name in enumerate(maps):
        log(tmp_path / f"{i}.csv")
        entries.append(f'{{ path = "{i}.csv", map = "{name}" }}')
    (tmp_path / "data.toml").write_text(f"recordings = [{', '.join(entries)}]\n")
    reader = DataSource(tmp_path / "data.toml").to_dict()
    source = read_as_before(DataSource(log(tmp_path / "new.csv")), reader)
    assert (source.signal_map is None) == (len(maps) > 1)
    assert os.fspath(source.path).endswith("new.csv")
