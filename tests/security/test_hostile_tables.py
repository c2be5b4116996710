"""CSV and Parquet files that are wide, long, lie about their size, or carry strange facts."""

from __future__ import annotations

import json
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edp.errors import DataError
from edp.logs import inspect_log, read_recording, write_recording
from edp.logs.detect import open_log
from edp.logs.formats.csv_table import CsvTable
from edp.logs.formats.edp_metadata import parse_edp_metadata
from edp.recording import Recording
from edp.signals import TABLE_A1, ChannelMap, SignalMap

BM_UP = SignalMap((ChannelMap("BmUp", "BmUp"),))


def processor_s(call: object, *args: object) -> float:
    start = time.process_time()
    call(*args)  # type: ignore[operator]
    return time.process_time() - start


def own_parquet(folder: Path) -> Path:
    values = np.arange(200, dtype=np.float32).reshape(100, 2)
    recording = Recording("R", (TABLE_A1["BmUp"], TABLE_A1["CylVels_1"]), values, 100.0)
    return write_recording(recording, folder / "a.parquet")


def test_wide_tables_take_seconds(tmp_path):
    columns = {"time": np.arange(50) / 100, "BmUp": np.arange(50.0)}
    columns |= {f"c{i}{end}": np.zeros(50) for i in range(2_000) for end in ("", "_time")}
    pq.write_table(pa.table(columns), tmp_path / "wide.parquet", use_dictionary=False)
    # The bound is that of any command on a hostile file; the quadratic form took minutes.
    assert processor_s(read_recording, tmp_path / "wide.parquet", SignalMap(sample_time_s=0.01)) < 10


def test_runs_of_zeros_are_weighed_before_they_are_read(tmp_path):
    rows = 200_000_000
    path = tmp_path / "zeros.parquet"
    schema = pa.schema([("BmUp", pa.bool_())])
    with pq.ParquetWriter(path, schema, compression="zstd") as writer:
        block = pa.table({"BmUp": np.zeros(rows // 4, dtype=bool)}, schema=schema)
        for _ in range(4):
            writer.write_table(block)
    assert path.stat().st_size < 1 << 20
    with pytest.raises(DataError, match="claims 200000000 values"):
        read_recording(path, SignalMap(sample_time_s=0.01))


def test_an_hour_of_one_value_is_read(tmp_path):
    pq.write_table(pa.table({"BmUp": np.zeros(3_600_000)}), tmp_path / "still.parquet")
    assert read_recording(tmp_path / "still.parquet", SignalMap(sample_time_s=0.001)).samples == 3_600_000


def facts_of(**changes: object) -> str:
    facts = {"name": "R", "rate_hz": 100.0, "source": "s", "meta": {}, "channels": []}
    return json.dumps(facts | changes)


def deep(levels: int) -> str:
    return facts_of(meta={"a": 0}).replace("0}", "[" * levels + "]" * levels + "}")


HOSTILE_FACTS = {
    "list": "[" * 100_000 + "]" * 100_000,
    "null": "null",
    "number": "7",
    "meta deep": deep(500),
    "meta very deep": deep(100_000),
    "meta a list": facts_of(meta=[1]),
    "rate 0": facts_of(rate_hz=0),
    "rate nan": facts_of(rate_hz=float("nan")),
    "rate inf": facts_of(rate_hz=float("inf")),
    "rate huge": facts_of(rate_hz=10**400),
    "rate a list": facts_of(rate_hz=[1]),
    "digits": facts_of(rate_hz=1).replace("1,", "1" * 6000 + ","),
    "channels a number": facts_of(channels=3),
    "channel a number": facts_of(channels=[3]),
    "kind unknown": facts_of(channels=[{"name": "a", "kind": "x", "description": ""}]),
    "description long": facts_of(channels=[{"name": "a", "kind": "generic", "description": "d" * 100_000}]),
    "name long": facts_of(name="n" * 100_000),
    "digest a list": facts_of(digest=[1]),
    "huge": facts_of(name="n" * (1 << 25)),
}


@pytest.mark.parametrize("what", HOSTILE_FACTS)
def test_facts_that_edp_never_wrote_are_refused(tmp_path, what):
    with pytest.raises(DataError, match="facts that EDP wrote into it are damaged") as refused:
        parse_edp_metadata(HOSTILE_FACTS[what], "'a'")
    assert len(str(refused.value)) < 600
    if len(HOSTILE_FACTS[what]) < 1 << 20:
        table = pq.read_table(own_parquet(tmp_path))
        table = table.replace_schema_metadata({b"edp_recording": HOSTILE_FACTS[what].encode()})
        pq.write_table(table, tmp_path / "b.parquet")
        with pytest.raises(DataError, match=r"b\.parquet.*are damaged"):
            read_recording(tmp_path / "b.parquet")


def test_inspection_tells_of_values_that_reading_refuses(tmp_path):
    path = own_parquet(tmp_path)
    assert not [finding for finding in inspect_log(path).errors if "EDP wrote" in finding.what]
    table = pq.read_table(path)
    changed = table.set_column(0, table.schema.field(0), pa.array(np.ones(100, dtype=np.float32)))
    pq.write_table(changed, path)
    with pytest.raises(DataError, match="not the ones that EDP wrote"):
        read_recording(path)
    assert any("not the ones that EDP wrote" in finding.what for finding in inspect_log(path).errors)


def test_row_counts_that_lie_are_refused(tmp_path):
    log = open_log(own_parquet(tmp_path), SignalMap())
    table = log.signals["BmUp"].table
    assert sum(len(piece[0]) for piece in table.pieces(["0"], 0, 100)) == 100
    with pytest.raises(DataError, match="ends after 100"):
        list(table.pieces(["0"], 0, 101))


@pytest.mark.parametrize("name", ["n" * 10_000, "n" * 100_000, "a\x07b", "a\nb", "\x1b[31mred", "a\x9bb"])
def test_names_that_nothing_can_carry_are_refused(tmp_path, name):
    pq.write_table(pa.table({"time": np.arange(50) / 50, "BmUp": np.zeros(50), name: np.zeros(50)}), tmp_path / "a.pq")
    with pytest.raises(DataError, match=r"rename it") as refused:
        read_recording(tmp_path / "a.pq")
    assert len(str(refused.value)) < 600
    assert str(refused.value).isprintable()


def rows(count: int, *cells: str) -> str:
    return "".join(f"{i / 100},{','.join(cells)}\n" for i in range(count))


HOSTILE_CSV = {
    "long cell": ("time,BmUp\n" + "0," + "1" * 200_000 + "\n" + rows(5, "1"), "cannot be read|holds text|not finite"),
    "long quoted cell": ('time,BmUp\n0,"' + "a" * 200_000 + '"\n', "cell has at most"),
    "long name": ("time," + "n" * 200_000 + "\n" + rows(5, "1"), "cell has at most|rename it"),
    "name of 10 kB": ("time," + "n" * 10_000 + "\n" + rows(5, "1"), "rename it"),
    "quote that never closes": ('time,"BmUp\n' + rows(20_000, "1"), "cell has at most"),
    "a million columns": (",".join(f"c{i}" for i in range(1_000_000)) + "\n" + ",".join("0" * 10) + "\n", "columns"),
    "one line without end": ("a" * (1 << 19), "cell has at most|no row|rename it"),
    "comments only": ("# c\n" * 100, "holds no rows"),
    "only a delimiter": ("sep=;\n", "holds no rows"),
}


@pytest.mark.parametrize("what", HOSTILE_CSV)
def test_tables_that_are_none_end_in_one_message(tmp_path, what):
    text, message = HOSTILE_CSV[what]
    (tmp_path / "a.csv").write_text(text)
    start = time.process_time()
    with pytest.raises(DataError, match=message) as refused:
        read_recording(tmp_path / "a.csv")
    assert time.process_time() - start < 10
    assert len(str(refused.value)) < 800


GOOD_CSV = {
    "stated delimiter": "sep=;\ntime;BmUp [bar]\n" + rows(10, "2").replace(",", ";"),
    "stated tab": "sep=\t\ntime\tBmUp [bar]\n" + rows(10, "2").replace(",", "\t"),
    "newline in the header": 'time,"BmUp\n[bar]"\n' + rows(10, "2"),
    "newlines in the header": '"time","BmUp\r\n\r\n[bar]"\r\n' + rows(10, "2").replace("\n", "\r\n"),
    "long comment": "# " + "c" * (1 << 19) + "\ntime,BmUp [bar]\n" + rows(10, "2"),
    "many comments": "# comment\n" * 100_000 + "time,BmUp [bar]\n" + rows(10, "2"),
    "odd line ends in a name": "time,a\u2028b,BmUp [bar]\n" + rows(10, "1", "2"),
    "no newline at the end": "time,BmUp [bar]\n" + rows(10, "2").rstrip("\n"),
    "units in a row": "time,BmUp\ns,bar\n" + rows(10, "2"),
}


@pytest.mark.parametrize("what", GOOD_CSV)
def test_tables_that_are_odd_but_sound_are_read(tmp_path, what):
    (tmp_path / "a.csv").write_bytes(GOOD_CSV[what].encode())
    np.testing.assert_allclose(read_recording(tmp_path / "a.csv", BM_UP).values, np.full((10, 1), 2e5))


def test_text_far_down_in_many_columns_takes_one_more_parse(tmp_path, monkeypatch):
    names = [f"c{i}" for i in range(400)]
    line = ",".join(["1.5"] * 400)
    late = ",".join(["text"] * 400)
    body = "".join(f"{i / 100},{i},{line}\n" for i in range(500))
    text = f"time,BmUp,{','.join(names)}\n{body}5.0,500,{late}\n5.01,501,{line}\n"
    (tmp_path / "a.csv").write_text(text)
    parses = []
    monkeypatch.setattr(
        CsvTable, "options", lambda self, keys, old=CsvTable.options: parses.append(1) or old(self, keys)
    )
    for decimal in (".", ","):
        if decimal == ",":
            text = text.replace(",", ";").replace(".", ",")
            (tmp_path / "a.csv").write_text(text)
        parses.clear()
        assert read_recording(tmp_path / "a.csv", BM_UP).samples == 502
        assert len(parses) <= 5
        with pytest.raises(DataError, match="column 'c7' holds text 'text' in line 502"):
            read_recording(tmp_path / "a.csv", SignalMap((ChannelMap("c7", "c7"),)))
