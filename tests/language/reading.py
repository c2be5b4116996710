"""Reading test: samples of the text of EDP that readers without the repository restate in one sentence.

1. ``make reading-test SEED=n`` writes ``items.md`` and ``key.json`` to ``build/reading/SEED``. `items.md` has no file
   names, and 10 % of its docstrings are controls from other projects.
2. A reader without the repository writes ``answers.json``: ``{"1": "one sentence, or unclear", ...}``.
3. A second reader with the code and ``key.json`` writes ``marks.json``: ``{"1": true, ...}``, true if right.
4. ``python tests/language/reading.py --score FOLDER`` prints the fraction understood by kind against the targets.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import json
import random
import re
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from english import ROOT, list_pages

COUNTS = {"docstring": 80, "name": 40, "comment": 30, "message": 30, "paragraph": 20}
TARGETS = {"docstring": 0.9, "name": 0.85, "comment": 0.9, "message": 0.9, "paragraph": 0.9}
TARGET = 0.95
CONTROL = "control"
CONTROLS = ("optuna.study", "optuna.trial", "optuna.samplers", "scipy.signal", "numpy.linalg")
CONTROL_SHARE = 0.1
MIN_WORDS = 4


@dataclass(frozen=True)
class Item:
    """Sample: its kind, its text as the reader sees it, and its place for the second reader."""

    kind: str
    text: str
    place: str


def draw_items(seed: int, root: Path = ROOT) -> list[Item]:
    """Return the shuffled samples of a seed, with controls in addition."""
    rng = random.Random(seed)
    pools: dict[str, list[Item]] = defaultdict(list)
    for path in sorted((root / "src" / "edp").rglob("*.py")):
        for item in read_module(path.read_text(encoding="utf-8"), path.relative_to(root).as_posix()):
            pools[item.kind].append(item)
    for page in list_pages(root):
        pools["paragraph"] += read_paragraphs(page.read_text(encoding="utf-8"), page.relative_to(root).as_posix())
    items = [item for kind, count in COUNTS.items() for item in rng.sample(pools[kind], min(count, len(pools[kind])))]
    controls = list(read_controls())
    items += rng.sample(controls, min(round(CONTROL_SHARE * COUNTS["docstring"]), len(controls)))
    rng.shuffle(items)
    return items


def read_module(source: str, file: str) -> Iterator[Item]:
    """Yield docstrings, function names with signatures, comments and error messages of a module."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
            place = f"{file}:{node.lineno} {node.name}"
            docstring = ast.get_docstring(node)
            if docstring:
                yield Item("docstring", docstring, place)
            if not isinstance(node, ast.ClassDef) and not node.name.startswith("__"):
                returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
                yield Item("name", f"{node.name}({ast.unparse(node.args)}){returns}", place)
        if (
            isinstance(node, ast.Call)
            and isinstance(node.func, ast.Name)
            and node.func.id.endswith("Error")
            and node.args
        ):
            text = node.args[0]
            if isinstance(text, ast.JoinedStr) or (isinstance(text, ast.Constant) and isinstance(text.value, str)):
                yield Item("message", ast.unparse(text), f"{file}:{node.lineno}")
    for block in re.finditer(r"(?:^[ ]*# (?!type:|fmt:|noqa).+\n)+", source, re.MULTILINE):
        text = " ".join(line.strip().removeprefix("# ") for line in block[0].splitlines())
        if len(text.split()) >= MIN_WORDS:
            yield Item("comment", text, f"{file}:{source.count(chr(10), 0, block.start()) + 1}")


def read_paragraphs(text: str, file: str) -> Iterator[Item]:
    """Yield the paragraphs of a page that are prose."""
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    for paragraph in re.split(r"\n\s*\n", prose):
        plain = " ".join(paragraph.split())
        if len(plain.split()) >= 5 * MIN_WORDS and plain[0].isalpha():
            yield Item("paragraph", plain, file)


def read_controls() -> Iterator[Item]:
    """Yield docstrings of public objects of other projects that are installed."""
    for name in CONTROLS:
        try:
            module = importlib.import_module(name)
        except ImportError:
            continue
        for label, value in sorted(vars(module).items()):
            text = inspect.getdoc(value) if inspect.isroutine(value) or inspect.isclass(value) else None
            if text and not label.startswith("_"):
                yield Item(CONTROL, text.split("\n\n")[0], f"{name}.{label}")


def write_items(items: list[Item], folder: Path) -> None:
    """Write ``items.md`` for the first reader and ``key.json`` for the second reader."""
    folder.mkdir(parents=True, exist_ok=True)
    parts = ["# Restate each item in one sentence, or write: unclear\n"]
    for number, item in enumerate(items, 1):
        kind = "docstring" if item.kind == CONTROL else item.kind
        parts.append(f"## {number} ({kind})\n\n```text\n{item.text.replace('```', '')}\n```\n")
    (folder / "items.md").write_text("\n".join(parts), encoding="utf-8")
    key = {number: asdict(item) for number, item in enumerate(items, 1)}
    (folder / "key.json").write_text(json.dumps(key, indent=1), encoding="utf-8")


def score(key: dict[str, dict[str, str]], marks: dict[str, bool]) -> dict[str, float]:
    """Return the fraction of right sentences by kind and ``all`` (without controls); an unmarked item is wrong."""
    right: dict[str, list[bool]] = defaultdict(list)
    for number, item in key.items():
        right[item["kind"]].append(marks.get(number, False))
        if item["kind"] != CONTROL:
            right["all"].append(marks.get(number, False))
    return {kind: sum(values) / len(values) for kind, values in right.items()}


def main() -> int:
    """Draw the samples of a seed, or print the score of a folder with ``marks.json``."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "reading")
    parser.add_argument("--score", type=Path, metavar="FOLDER")
    arguments = parser.parse_args()
    if arguments.score is None:
        folder = arguments.out / str(arguments.seed)
        items = draw_items(arguments.seed)
        write_items(items, folder)
        print(f"{len(items)} items: {folder / 'items.md'}; key for the second reader: {folder / 'key.json'}")
        return 0
    key, marks = (
        json.loads((arguments.score / name).read_text(encoding="utf-8")) for name in ("key.json", "marks.json")
    )
    scores = score(key, marks)
    targets = {**TARGETS, "all": TARGET}
    for kind, value in sorted(scores.items()):
        print(f"{kind:10} {value:6.1%}" + (f"  target {targets[kind]:.0%}" if kind in targets else ""))
    return int(any(scores.get(kind, 0.0) < target for kind, target in targets.items()))


if __name__ == "__main__":
    sys.exit(main())
