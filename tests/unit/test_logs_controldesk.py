"""Text exports of dSPACE ControlDesk, made here from synthetic numbers, and damaged ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import inspect_log, read_recording
from edp.recording import Recording
from edp.signals import ChannelMap, Kind, SignalMap
from edp.workflows.proposal import propose

pytestmark = pytest.mark.processes

WHOLE = SignalMap(others=True)
PATHS = ("", "Root/pressure (2022)/Boom_P", "Root/pressure (2022)/Arm_P", "Root/valves", "Root/gain")
NAMES = ("", "In1", "In1", "Boom_duty", "Value")


def export(
    rows: list[str], delimiter: str = ",", names: tuple[str, ...] = NAMES, paths: tuple[str, ...] = PATHS
) -> str:
    head = [
        ("descriptions", "General", "User", "somebody"),
        ("", "General", "Origin", '"Platform / Device: one\nControlDesk version: 7.2"'),
        (),
        ("trace_size", str(len(rows))),
        ("trace_names", *names),
        ("trace_units", "", "bar", "bar", "%", ""),
        ("path", *paths),
        ("min", "", *("-1.797693135e+308" for _ in names[1:])),
    ]
    body = [f"{'trace_values' if i == 0 else ''}{delimiter}{row}" for i, row in enumerate(rows)]
    return "\n".join([*(delimiter.join(cells) for cells in head), *body]) + "\n"


def numbers(count: int, delimiter: str = ",", sign: str = ".") -> list[str]:
    rows = ([i / 100, 100 + i, 50 - i, float(i > 3), 2.5] for i in range(count))
    return [delimiter.join(f"{value:.4f}".replace(".", sign) for value in row) for row in rows]


def written(folder: Path, text: str, encoding: str = "utf-8") -> Path:
    path = folder / "desk.csv"
    path.write_bytes(text.encode(encoding))
    return path


def read(folder: Path, text: str) -> Recording:
    return read_recording(written(folder, text), WHOLE)


@pytest.mark.parametrize(("delimiter", "sign"), [(",", "."), (";", ","), ("\t", ".")])
def test_traces_have_time_units_and_the_names_of_their_blocks(tmp_path, delimiter, sign):
    made = read(tmp_path, export(numbers(30, delimiter, sign), delimiter))
    assert made.channel_names == ("Boom_P", "Arm_P", "Boom_duty", "gain")
    assert made.rate_hz == pytest.approx(100.0)
    np.testing.assert_allclose(made.values[5], [105e5, 45e5, 0.01, 2.5], rtol=1e-6)


def test_a_trace_is_found_by_its_path_and_a_shared_name_says_so(tmp_path):
    path = written(tmp_path, export(numbers(30)))
    by_path = SignalMap((ChannelMap("arm", PATHS[2], "1", Kind.GENERIC),))
    np.testing.assert_array_equal(read_recording(path, by_path).values[:3, 0], [50, 49, 48])
    with pytest.raises(DataError, match="2 columns named 'In1': Boom_P"):
        read_recording(path, SignalMap((ChannelMap("arm", "In1", "1", Kind.GENERIC),)))


def test_a_slower_raster_has_its_own_time(tmp_path):
    rows = [f"{i / 100},{i},{i / 50 if i < 10 else ''},{2 * i if i < 10 else ''}" for i in range(20)]
    text = export(rows, names=("", "fast", "", "slow"), paths=("", "a/fast", "", "a/slow"))
    made = read(tmp_path, text.replace("trace_units,,bar,bar,%,", "trace_units,,,,"))
    assert made.channel_names == ("fast", "slow")
    # The slower one lasts 0.18 s, the faster 0.19 s; between its samples it is held.
    np.testing.assert_array_equal(made.values[:5], [[0, 0], [1, 0], [2, 2], [3, 2], [4, 4]])


def test_text_of_another_encoding_in_the_head_is_no_hindrance(tmp_path):
    path = written(tmp_path, export(numbers(30)).replace("somebody", "\x81\xbf\xc0"), "latin-1")
    assert read_recording(path, WHOLE).samples == 30
    assert inspect_log(path).verdict != "unusable"


def test_columns_are_proposed_with_kinds(tmp_path):
    count = 2000
    swing = np.sin(np.arange(count) / 40)
    rows = [
        f"{i / 100},{120 + 40 * swing[i]:.4f},{60 - 20 * swing[i]:.4f},{50.0 * (i // 200 % 2)},2" for i in range(count)
    ]
    text = export(rows).replace("trace_units,,bar,bar,%,", "trace_units,,,,,")
    found = propose(written(tmp_path, text.replace("/Boom_P", "/Boom_Cyl_P").replace("/Arm_P", "/Arm_Cyl_P")))
    kinds = {guess.column: (guess.role, str(guess.kind.kind), guess.kind.unit) for guess in found.proposal.columns}
    assert kinds["Boom_Cyl_P"] == ("measured", "pressure", "bar")
    assert kinds["Boom_duty"] == ("command", "ratio", "%")
    assert found.proposal.clock.rate_hz == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("trace_values", "values", "no row 'trace_values'"),
        ("trace_names,,In1", "trace_names,first,In1", "no column of time before its traces"),
        ("\n,0.0500", "\n,later", "holds text 'later' in line"),
        ("\n,0.0500", "\n,0.0500,9,9", "line 15 has 8 cells"),
        ("trace_size", "trace_names,\n" * 300 + "trace_size", "no row 'trace_values'"),
        ("Platform", "P" * 200_000, "cannot be read"),
    ],
)
def test_a_damaged_export_is_refused_in_one_sentence(tmp_path, old, new, problem):
    text = export(numbers(30))
    assert old in text
    with pytest.raises(DataError, match=problem):
        read(tmp_path, text.replace(old, new))
