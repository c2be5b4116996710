"""`edp data check` of logs that nobody described, and of many logs: a line each first."""

import csv
import time

import numpy as np
import pytest

from edp.cli import console
from edp.logs import write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1


def log(path, seed=0, header=("t", "u [V]", "p [bar]", "gain")):
    draw = np.random.default_rng(seed)
    rows = zip(np.arange(600) / 50, np.repeat(draw.normal(size=12), 50), 100 + draw.normal(size=600), np.ones(600))
    with path.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        if header:
            writer.writerow(header)
        writer.writerows([f"{cell:.4f}" for cell in row] for row in rows)
    return path


@pytest.mark.parametrize("header", [("t", "u [V]", "p [bar]", "gain"), None])
def test_any_columns_are_inspected_without_a_map(edp, tmp_path, header):
    path = log(tmp_path / "x.csv", header=header)
    ended = edp("data", "check", path, "--json")
    assert ended.code == 0
    report = ended.json["recordings"][0]
    assert report["proposed"]
    assert (report["rate_hz"], report["samples"], len(report["channels"])) == (50.0, 600, 3)
    assert {channel["unit"] for channel in report["channels"]} == ({"V", "bar", "1"} if header else {"1"})
    shown = edp("data", "check", path).out
    assert f"next: edp init {path}" in shown
    assert "edp init writes a map to check" in shown


def test_what_needs_a_map_says_so(edp, tmp_path):
    ended = edp("data", "check", log(tmp_path / "x.csv"), "--split", "time")
    assert ended.code == 1
    assert "edp init proposes one (--map)" in ended.err


def test_nearly_known_names_are_still_answered_with_the_names(edp, tmp_path):
    ended = edp("data", "check", log(tmp_path / "x.csv", header=("t", "CylVel_1", "CylVel_2", "b")))
    assert ended.code == 3
    assert "did you mean 'CylVels_1'" in ended.out


def excavator(folder, count):
    draw = np.random.default_rng(0)
    folder.mkdir()
    for i in range(count):
        values = draw.normal(size=(400, len(TABLE_A1))).astype(np.float32)
        values[:, 3] = 0.0
        write_recording(Recording(f"run_{i}", tuple(TABLE_A1.values()), values, 100.0), folder / f"run_{i}.parquet")
    return folder


def test_many_logs_have_a_line_each_and_details_on_demand(edp, tmp_path):
    folder = excavator(tmp_path / "logs", 6)
    short = edp("data", "check", folder, "--no-coverage").out
    assert len(short.splitlines()) < 50
    assert [line.split()[0] for line in short.splitlines()[1:7]] == [f"run_{i}" for i in range(6)]
    # One kind of finding stands once, with the logs that have it.
    assert short.count("CylAcc_1: constant") == 1
    assert "in 6 of 6 logs: run_0, run_1, run_2, run_3, ..." in short
    assert len(edp("data", "check", folder, "--no-coverage", "--details").out.splitlines()) > 200


def test_tables_fit_into_the_terminal_with_whole_names(edp, tmp_path, monkeypatch):
    folder = excavator(tmp_path / "logs", 1)
    monkeypatch.setenv("COLUMNS", "80")
    shown = edp("data", "check", folder, "--details", "--no-coverage").out
    tables = [line for line in shown.splitlines() if line.startswith(("Cyl", "channel", "Bm", "Am", "Bkt"))]
    assert max(map(len, tables)) <= 80
    for name in TABLE_A1:
        assert any(line.startswith(name + " ") for line in tables), name


def test_wide_tables_are_parted_into_blocks(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "30")
    console.table("wide", ["name", "first", "second", "third"], [["CylPressures_1", 1.5, "22222222", 1234567]])
    lines = [line.rstrip() for line in capsys.readouterr().out.splitlines()]
    assert lines[0] == "wide"
    assert max(map(len, lines)) <= 30
    assert sum(line.startswith("CylPressures_1") for line in lines) == 3
    assert any(line.endswith("1,234,567") for line in lines)
    console.table("", ["name"], [["x" * 90]])
    assert capsys.readouterr().out.replace("\n", "").count("x") == 90


@pytest.mark.parametrize("show", [console.table, console.listing])
@pytest.mark.parametrize("name", [9, 60, 200])
@pytest.mark.parametrize("cell", [3, 70, 300])
def test_no_character_of_a_table_is_lost_at_80_columns_however_wide_it_is(capsys, monkeypatch, show, name, cell):
    monkeypatch.setenv("COLUMNS", "80")
    rows = [[f"CylPressures_{n}".ljust(name, "x"), "over: ".ljust(cell - 1, "y") + str(n), "5"] for n in range(3)]
    show("", ["name", "budget", "k"], rows)
    shown = capsys.readouterr().out
    assert max(map(len, shown.splitlines())) <= 80
    packed = "".join(shown.split())
    for letter, wanted in (("x", 3 * max(name - 14, 0)), ("y", 3 * max(cell - 7, 0))):
        assert packed.count(letter) >= wanted
    assert all(f"CylPressures_{n}" in shown for n in range(3))


def test_what_takes_long_says_so_again_until_it_ends(capsys):
    with console.waiting("compiling", every_s=0.01):
        for _ in range(500):
            if "so far" in capsys.readouterr().err:
                break
            time.sleep(0.01)
        else:
            pytest.fail("nothing was said while it ran")
    capsys.readouterr()
    with console.waiting("compiling", quiet=True, every_s=0.01):
        time.sleep(0.05)
    assert capsys.readouterr().err == ""
    with pytest.raises(ValueError, match="stop"), console.waiting("compiling"):
        raise ValueError("stop")
    assert capsys.readouterr().err.count("compiling") == 1
