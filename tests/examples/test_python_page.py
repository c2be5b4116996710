"""The Python of docs/reference/python.md and of the README runs as it stands."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "python.md"
README_LINES = 5
"""Behind the data, which are made up there."""


def blocks_of(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", [ROOT / "README.md", PAGE], ids=lambda page: page.name)
def test_python_on_the_page_runs_as_it_stands(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blocks = blocks_of(page)
    assert blocks
    namespace: dict[str, object] = {"__name__": "page"}
    for number, block in enumerate(blocks):
        exec(compile(block, f"{page.name}, block {number}", "exec"), namespace)
    assert "Ridge ARX" in capsys.readouterr().out
    assert (tmp_path / "out" / "predictor.c").is_file()


def test_the_readme_shows_the_whole_way_in_a_few_lines():
    (block,) = blocks_of(ROOT / "README.md")
    made_up, _, way = block.partition("\n\ntrain, test")
    assert "import edp" in made_up
    assert len(way.strip().splitlines()) == README_LINES
    for call in ("edp.train(", ".evaluate(", ".export(", ".stream("):
        assert call in block
