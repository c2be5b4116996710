"""Text files as loggers and spreadsheets write them: lines above the table, German numbers and dates, no header."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from edp.errors import DataError
from edp.logs import read_recording
from edp.logs.formats.csv_dates import dates_of
from edp.recording import Recording
from edp.signals import ChannelMap, SignalMap

pytestmark = pytest.mark.processes

WHOLE = SignalMap(others=True)


@pytest.fixture
def read(tmp_path: Path) -> Callable[..., Recording]:
    def of(text: str, signal_map: SignalMap = WHOLE) -> Recording:
        path = tmp_path / "log.csv"
        path.write_bytes(text.encode())
        return read_recording(path, signal_map)

    return of


def lines(form: Callable[[int], str], count: int = 30) -> str:
    return "".join(f"{form(i)}\n" for i in range(count))


def test_lines_of_a_logger_above_names_and_units(read):
    head = "Logger XY 2000\nSerial;4711\nDate;01.02.2024\n\ntime;Druck;Weg\ns;bar;mm\n"
    made = read(head + lines(lambda i: f"0,{i:02d};1.234,{i};{i},5"))
    assert made.channel_names == ("Druck", "Weg")
    assert made.rate_hz == 100.0
    np.testing.assert_allclose(made.values[1], [1234.1e5, 1.5e-3], rtol=1e-6)


def test_lines_filled_up_to_the_width_of_the_table(read):
    made = read("Messung;;\nNr;12;\ntime;Druck;Weg\n" + lines(lambda i: f"{i};{i};{i},5"))
    assert made.channel_names == ("Druck", "Weg")
    assert made.values[3].tolist() == [3.0, 3.5]


def test_pairs_above_a_table_of_two_columns(read):
    made = read("Name;Value\nSerial;12\nTime;P\n" + lines(lambda i: f"{i};{i + 5}"))
    assert made.channel_names == ("P",)
    assert made.values[:2, 0].tolist() == [5.0, 6.0]


def test_delimiter_is_that_of_the_numbers(read):
    made = read("Rig A, run 2, operator: X\nfoo\nbar\ntime;a;b\n" + lines(lambda i: f"{i},5;2,25;3,125"))
    assert made.channel_names == ("a", "b")
    assert made.values[0].tolist() == [2.25, 3.125]


def test_names_descriptions_and_units(read):
    head = "t\ta\tb\nTime since start of test\tPressure of side A\tForce of rod\ns\tbar\tkN\n"
    made = read(head + lines(lambda i: f"{i}\t2.5\t3"))
    assert made.channel_names == ("a", "b")
    assert made.values[0].tolist() == [250_000.0, 3000.0]


@pytest.mark.parametrize("stamp", ["01.02.2024 13:00:{:02d},500", "13:00:{:02d}", "2024-02-01T13:00:{:02d},5"])
def test_german_dates_and_times_of_day(read, stamp):
    made = read("time;a\n" + lines(lambda i: f"{stamp.format(i)};1,5"))
    assert made.rate_hz == 1.0
    assert made.values[:, 0].tolist() == [1.5] * 30


def test_american_dates_and_remarks_of_a_logger_behind_the_rows(read):
    head = "Sampling Rate:  10\nSample Number, Date/Time, U, V, Events\n"
    rows = [f"{i + 1},   06/29/2022 12:59:{56 + i // 10:02d}.{i % 10}00 PM, {i}.5, 2" for i in range(30)]
    rows[0] += ", DAQ Start"
    rows[-1] += ", DAQ Pause, DAQ Stop"
    made = read(head + "\n".join(rows) + "\n")
    assert made.channel_names == ("Sample Number", "U", "V")
    assert made.rate_hz == pytest.approx(10.0)
    assert made.values[:, 1].tolist() == [i + 0.5 for i in range(1, 29)]  # rows with remarks are left out


@pytest.mark.parametrize("bad", ["7, 06/29/2022 01:00:00.700 PM, 1.0, 2, 3.5", "7, 06/29/2022 01:00:00.700 PM, 1.0"])
def test_damaged_rows_among_such_are_refused(read, bad):
    rows = [f"{i}, 06/29/2022 01:00:{i // 10:02d}.{i % 10}00 PM, 0.5, 2" for i in range(30)]
    rows[7] = bad
    with pytest.raises(DataError, match="line 9 has"):
        read("N, Date/Time, U, V\n" + "\n".join(rows) + "\n")


@pytest.mark.parametrize(("stamp", "hour"), [("12:05:00 AM", 0), ("12:05:00 PM", 12), ("01:05:00 pm", 13)])
def test_halves_of_a_day(stamp, hour):
    assert str(dates_of([f"06/29/2022 {stamp}"])[0])[:16] == f"2022-06-29T{hour:02d}:05"


def test_thirteen_o_clock_has_no_half():
    with pytest.raises(ValueError, match="half a day"):
        dates_of(["06/29/2022 13:05:00 PM"])


@pytest.mark.parametrize("remark", ["# t, u, y", "% t u y", "#t,u,y"])
def test_names_in_the_comment_above_numbers(read, remark):
    made = read(f"# Rig A\n{remark}\n" + lines(lambda i: f"{i},2,{i}"))
    assert made.channel_names == ("u", "y")
    assert made.rate_hz == 1.0


def test_no_names_at_all_go_by_place_where_the_file_is_taken_whole(read):
    text = lines(lambda i: f"{i},2,{i}")
    made = read(text, SignalMap(others=True, sample_time_s=0.5))
    assert made.channel_names == ("column_1", "column_2", "column_3")
    assert made.values[0].tolist() == [0.0, 2.0, 0.0]
    with pytest.raises(DataError, match=r"first row holds numbers.*edp init"):
        read(text, SignalMap((ChannelMap("u", "u"),)))


def test_points_for_thousands(read):
    made = read("time;n;a\n" + lines(lambda i: f"{i};1.{i:03d};0,5"))
    assert made.select(["n", "a"])[:2].tolist() == [[1000.0, 0.5], [1001.0, 0.5]]
    late = read("time;n;a\n" + lines(lambda i: f"{i};{1000 + i};0,5", 300) + "300;-1.500,25;0,5\n")
    assert late.column("n")[-1] == -1500.25


def test_what_may_be_either_is_read_as_before(read):
    """Three digits behind each sign prove nothing: the point stays the decimal sign, the other column text."""
    made = read("time;n;a\n" + lines(lambda i: f"{i};1.{i:03d};2,345"))
    assert made.channel_names == ("n",)
    assert made.values[1, 0] == pytest.approx(1.001)


def test_text_among_german_numbers_is_refused_with_its_line(read):
    text = "time;n\n" + lines(lambda i: f"{i};1.{i:03d},5") + "30;off\n"
    with pytest.raises(DataError, match=r"column 'n' holds text 'off' in line 32"):
        read(text, SignalMap((ChannelMap("n", "n"),)))


def test_decimal_commas_in_quotes_between_commas(read):
    made = read('time,"a b","c"\n' + lines(lambda i: f'{i},"1,5","2,{i}"'))
    assert made.values[1].tolist() == pytest.approx([1.5, 2.1])
    # 1,234 in quotes may be a thousand: it stays text.
    assert read("time,a,c\n" + lines(lambda i: f'{i},"1,234",2')).channel_names == ("c",)


def test_rows_that_end_with_a_delimiter(read):
    made = read("time;a;b\n" + lines(lambda i: f"{i};2;3;"))
    assert made.channel_names == ("a", "b")
    assert made.samples == 30


def test_rows_of_text_before_numbers_are_not_left_out(read):
    """The first row stays the header, and the column of text is refused where it is asked for."""
    text = "time;a;b\n" + lines(lambda i: f"{i};off;off", 8) + lines(lambda i: f"{8 + i};1;2")
    with pytest.raises(DataError, match="holds text 'off' in line 2"):
        read(text, SignalMap((ChannelMap("a", "a"),)))


def scope(delimiter: str = "\t", comma: str = ",", padded: bool = True) -> str:
    """An export of TwinCAT Scope: a channel at 5 kHz, then two at 1 kHz under one time."""
    facts = [
        ("Name", "fast valve", "Name", "p A", "stroke"),
        ("SymbolComment", "", "SymbolComment", "", ""),
        ("Data-Type", "REAL32", "Data-Type", "REAL64", "REAL64"),
        ("SampleTime[ms]", f"0{comma}2", "SampleTime[ms]", "1", "1"),
        ("Unit", "(None)", "Unit", "bar (Pressure)", "mm (Length)"),
        ("Unit Offset", "0", "Unit Offset", "0", "0"),
    ]
    rows = []
    for k in range(500):
        slow = (str(k), f"{100 + k}{comma}5", str(k % 7)) if k < 100 else (" ",) * 3 if padded else ()
        rows.append((f"{0.2 * k:.1f}".replace(".", comma), str(k), *slow))
    head = f"Name{delimiter}run\nStarttime of export{delimiter}1329{delimiter}Montag, 2. Mai\n\n"
    table = "".join(delimiter.join(row) + "\n" for row in facts) + "\n"
    return head + table + "".join(delimiter.join(row) + "\n" for row in rows) + "EOF\n"


@pytest.mark.parametrize(("delimiter", "comma", "padded"), [("\t", ",", True), (";", ",", False), (",", ".", False)])
def test_exports_of_a_scope_have_a_time_for_each_group_of_channels(read, delimiter, comma, padded):
    made = read(scope(delimiter, comma, padded))
    assert made.channel_names == ("fast valve", "p A", "stroke")
    assert made.rate_hz == pytest.approx(5000.0)
    # 0 to 99 ms are known of all; the slow ones hold for five rows.
    np.testing.assert_allclose(made.values[:12, 1], np.repeat([100.5e5, 101.5e5, 102.5e5], 5)[:12])
    np.testing.assert_allclose(made.values[-1], [495, 199.5e5, 99 % 7 * 1e-3], rtol=1e-6)


def test_an_export_of_a_scope_whose_delimiter_is_in_its_cells_is_refused(read):
    with pytest.raises(DataError, match="export it with a tab or a semicolon"):
        read(scope(","))


@pytest.mark.parametrize("bad", ["1\t2\tnot a number\t3\t4", "1\t2\t3\t4\t5\t6\t7"])
def test_a_damaged_export_of_a_scope_is_refused(read, bad):
    with pytest.raises(DataError, match="TwinCAT Scope"):
        read(scope().replace("EOF", f"{bad}\nEOF"))
