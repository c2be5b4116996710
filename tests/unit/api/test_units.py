"""Units that a user writes: unknown ones are refused wherever one is taken."""

import inspect
import re

import numpy as np
import pytest

import edp
from edp.errors import DataError, EdpError
from edp.logs.units import ALIASES, OTHER_UNITS, check_unit
from edp.recording import Recording
from edp.signals import TIME_UNITS, UNITS, ChannelMap, SignalMap
from edp.workflows.live.sources import udp

VALUES = np.ones((5, 1))


def _arrays(unit, folder):
    return edp.Recordings.from_arrays([VALUES], rate_hz=100, names=["p"], units=[unit])


def _arrays_by_name(unit, folder):
    return edp.Recordings.from_arrays([VALUES], rate_hz=100, names=["p"], units={"p": unit})


def _pandas(unit, folder):
    return edp.Recordings.from_frames(
        pytest.importorskip("pandas").DataFrame({"p": VALUES[:, 0]}), rate_hz=100, units={"p": unit}
    )


def _polars(unit, folder):
    return edp.Recordings.from_frames(
        pytest.importorskip("polars").DataFrame({"p": VALUES[:, 0]}), rate_hz=100, units={"p": unit}
    )


def _map(unit, folder):
    (folder / "log.csv").write_text("time_s,c\n" + "".join(f"{k / 100},1\n" for k in range(5)))
    return edp.read(folder / "log.csv", map={"channels": {"p": {"column": "c", "unit": unit}}})


def _udp(unit, folder):
    return udp._conversions(SignalMap((ChannelMap("p", "c", unit),)))


DOORS = {
    "Recordings.from_arrays": (_arrays, _arrays_by_name),
    "Recordings.from_frames": (_pandas, _polars),
    "read": (_map,),
    "edp live --source udp": (_udp,),
}


@pytest.mark.parametrize("door", [door for doors in DOORS.values() for door in doors], ids=lambda door: door.__name__)
def test_unknown_units_are_refused_with_channel_and_closest_units(door, tmp_path):
    with pytest.raises(EdpError, match=r"'p'.*unknown unit 'barr'; did you mean 'bar'.*leave it out"):
        door("barr", tmp_path)
    door("bar", tmp_path)
    door("kW", tmp_path)


def test_every_public_parameter_of_units_is_tested_here():
    """Fails where a public function begins to take a unit that no test above covers."""
    taking = set()
    for name in edp.__all__:
        part = getattr(edp, name)
        members = {name: part} if inspect.isfunction(part) else {}
        if inspect.isclass(part):
            members = {f"{name}.{member}": value for member, value in inspect.getmembers(part, callable)}
        for path, member in members.items():
            if path.rpartition(".")[2].startswith("_"):
                continue
            try:
                parameters = inspect.signature(member).parameters
            except (TypeError, ValueError):
                continue
            if {"unit", "units", "map", "signal_map"} & set(parameters):
                taking.add(path)
    assert taking == {"Recordings.from_arrays", "Recordings.from_frames", "read"}
    assert taking <= set(DOORS)


@pytest.mark.parametrize("unit", sorted({*UNITS, *ALIASES, *OTHER_UNITS, *TIME_UNITS}))
def test_every_known_spelling_is_taken(unit):
    assert check_unit(f" {unit} ", "here") == ALIASES.get(unit, unit)


def test_no_unit_is_no_fault():
    assert check_unit(None, "here") is None
    assert check_unit("  ", "here") is None


@pytest.mark.parametrize("unit", ["\x1b[2J", "x" * 100_000, "furlong", "km/h"])
def test_the_message_of_any_text_is_short_and_printable(unit):
    with pytest.raises(DataError) as error:
        check_unit(unit, "here")
    assert len(str(error.value)) < 600
    assert "\x1b" not in str(error.value)


def test_units_of_files_are_taken_as_they_are(tmp_path):
    (tmp_path / "log.csv").write_text("time_s,c [furlong]\n" + "".join(f"{k / 100},1\n" for k in range(5)))
    assert isinstance(edp.read(tmp_path / "log.csv")[0], Recording)


def test_conversion_factors_are_looked_up_in_one_place_only():
    from pathlib import Path

    source = Path(edp.__file__).parent
    callers = {
        str(path.relative_to(source))
        for path in source.rglob("*.py")
        if re.search(r"import [^\n]*\bconversion\b", path.read_text(encoding="utf-8"))
    }
    assert callers == {"logs/units.py"}
