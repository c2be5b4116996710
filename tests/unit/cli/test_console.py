"""What commands print to a terminal, a pipe and a file."""

import io

import pytest

from edp.cli import console

LONG = "/".join(["a folder of a long path"] * 20)


@pytest.fixture
def printed(monkeypatch):
    """Print a table and a listing with a long path; return the lines, by the width that `COLUMNS` states."""

    def run(columns: int | None) -> list[str]:
        shown = console.Terminal()
        shown.file = io.StringIO()
        monkeypatch.setattr(console, "out", shown)
        if columns is not None:
            monkeypatch.setenv("COLUMNS", str(columns))
        console.table("", ["name", *(f"figure {i}" for i in range(30))], [[LONG, *range(30)]])
        console.listing("", ["file", "state"], [[LONG, "read"]])
        return shown.file.getvalue().splitlines()

    return run


def test_rows_in_a_pipe_stay_on_one_line(printed):
    lines = printed(None)
    assert len(lines) == 4
    assert [line.startswith(LONG) for line in lines] == [False, True, False, True]


def test_rows_are_folded_to_the_stated_columns_and_keep_every_character(printed):
    lines = printed(60)
    assert max(map(len, lines)) <= 60
    first_column = "".join(line[:30].rstrip(" ") for line in lines)
    assert "a folder of a long" in first_column
    assert "29" in " ".join(lines)
