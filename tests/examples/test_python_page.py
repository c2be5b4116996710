"""docs/python.md and the README's Python run as they stand, and the page lists the public names, all of them."""

import dataclasses
import inspect
import re
from pathlib import Path

import pytest

import edp

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "python.md"
README_LINES = 5
"""Behind the data, which are made up there."""


def blocks_of(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)


def members_of(part: object) -> set[str]:
    """Public methods, properties and attributes of a class or module."""
    if inspect.ismodule(part):
        return set(part.__all__)
    # Those of a base class of the front door are members, too.
    bases = [base for base in part.__mro__ if base is part or base.__module__.startswith("edp.workflows.api.")]
    names = {name for base in bases for name in vars(base) if not name.startswith("_")}
    return names | ({field.name for field in dataclasses.fields(part)} if dataclasses.is_dataclass(part) else set())


def test_the_page_lists_every_public_name_and_no_other():
    listed = re.findall(r"^\| `([\w.]+)` \| [^|]+ \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert len(listed) == len(set(listed))
    headings = {f"edp.{name}" for name in edp.__all__}
    assert {name for name in listed if name.startswith("edp.")} == headings
    parts = {name: getattr(edp, name) for name in edp.__all__}
    classes = {name: part for name, part in parts.items() if inspect.isclass(part) or inspect.ismodule(part)}
    members = {f"{name}.{member}" for name, part in classes.items() for member in members_of(part)}
    assert {name for name in listed if not name.startswith("edp.")} == members


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
