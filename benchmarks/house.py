"""How the code is laid out: is the package small enough in the large to be learnt by reading its folders?

Counts are taken from the syntax trees of ``src/edp``; nothing is imported. The rival of every figure is the bound that
the project set itself. The full form also times ``make check`` and ``make test``, by their processor time.
"""

from __future__ import annotations

import ast
import io
import itertools
import os
import re
import resource
import subprocess
import tokenize
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from common import Bench, benchmark, table

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "edp"
MAX_PARAMETERS, LONG_FILE = 7, 600
BANNED = frozenset({
    "held", "found", "made", "place", "known", "given", "said", "told", "taken", "wanted", "kept", "got", "thing",
    "stuff",
})  # fmt: skip
"""Names that say how a value was come by and not what it is."""
ALIAS, SHOWN_TABLE = "Table", "edp.table"  # alias of dict[str, Any], and the module of a class of the same name
OPEN_DICTIONARY = re.compile(r"\b(?:dict|Mapping)\[str, Any\]")
SHORT_BODY = 2
LINES_BEFORE = 143_389
"""Lines of ``src/edp`` at commit 521d1128, before runs, jobs, results and pages were unified; 4,500 were to go."""


@dataclass
class House:
    """What is counted.

    Attributes:
        modules: number of Python files.
        siblings: names directly below the package.
        floors: longest chain of rooms that import one another.
        arrows: pairs of rooms of which one imports the other.
        circles: groups of modules that import one another in a circle, by their names.
        wide_functions: functions outside the command line with more than `MAX_PARAMETERS` parameters besides ``self``.
        long_files: files of more than `LONG_FILE` lines.
        comments: comments for each 100 lines of code, and the strings that explain a constant below its assignment.
        docstrings: docstrings for each 100 lines of code.
        duplicates: public classes whose name stands in more than one module.
        banned: assigned variables with a banned name, ``file:line name``.
        lines: lines of Python.
        templates: lines of Jinja templates.
        open_dictionaries: uses of ``dict[str, Any]``, of ``Mapping[str, Any]``, and of the alias ``Table``.
        short_bodies: percentage of functions whose body without docstring has at most two lines.
    """

    modules: int = 0
    siblings: list[str] = field(default_factory=list)
    floors: int = 0
    arrows: int = 0
    circles: list[list[str]] = field(default_factory=list)
    wide_functions: list[str] = field(default_factory=list)
    long_files: list[str] = field(default_factory=list)
    comments: float = 0.0
    docstrings: float = 0.0
    duplicates: dict[str, int] = field(default_factory=dict)
    banned: list[str] = field(default_factory=list)
    lines: int = 0
    templates: int = 0
    open_dictionaries: int = 0
    short_bodies: float = 0.0


def measure(package: Path = PACKAGE) -> House:
    """Count a package; `package` is its folder."""
    files = {_module(path, package): path for path in sorted(package.rglob("*.py"))}
    trees = {name: ast.parse(path.read_text(encoding="utf-8")) for name, path in files.items()}
    house = House(modules=len(files))
    folders = (entry for entry in package.iterdir() if entry.suffix == ".py" or (entry / "__init__.py").exists())
    house.siblings = sorted(entry.stem for entry in folders if not entry.stem.startswith("__"))
    nodes = {name: list(ast.walk(tree)) for name, tree in trees.items()}
    imports = {name: _imports(name, nodes[name], trees.keys()) for name in trees}
    rooms: dict[str, set[str]] = {room: set() for room in house.siblings}
    for name, targets in imports.items():
        for target in targets:
            source_room, target_room = _room(name), _room(target)
            if source_room in rooms and target_room in rooms and source_room != target_room:
                rooms[source_room].add(target_room)
    house.arrows = sum(map(len, rooms.values()))
    house.floors = max((_depth(room, rooms, ()) for room in rooms), default=0)
    house.circles = [sorted(group) for group in _circles(imports) if len(group) > 1]
    classes: Counter[str] = Counter()
    comments = docstrings = functions = short = 0
    for name, tree in trees.items():
        text = files[name].read_text(encoding="utf-8")
        count = text.count("\n")
        house.lines += count
        house.open_dictionaries += len(OPEN_DICTIONARY.findall(text)) + _uses_of_alias(nodes[name])
        comments += sum(
            token.type == tokenize.COMMENT for token in tokenize.generate_tokens(io.StringIO(text).readline)
        )
        comments += sum(map(_constant_docstrings, nodes[name]))
        where = files[name].relative_to(package.parent)
        if count > LONG_FILE:
            house.long_files.append(f"{where} {count}")
        for node in nodes[name]:
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
                docstrings += ast.get_docstring(node) is not None
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                functions += 1
                short += _body_lines(node) <= SHORT_BODY
            if isinstance(node, ast.FunctionDef) and parameters_of(node) > MAX_PARAMETERS and "cli" not in where.parts:
                house.wide_functions.append(f"{where}:{node.lineno} {node.name}")
        classes.update(node.name for node in tree.body if isinstance(node, ast.ClassDef) and node.name[0] != "_")
        house.banned += [f"{where}:{line} {variable}" for variable, line in assigned(nodes[name]) if variable in BANNED]
    house.comments, house.docstrings = 100 * comments / house.lines, 100 * docstrings / house.lines
    house.short_bodies = 100 * short / functions
    house.templates = sum(path.read_text(encoding="utf-8").count("\n") for path in package.rglob("*.jinja"))
    house.duplicates = {name: count for name, count in sorted(classes.items()) if count > 1}
    return house


def parameters_of(function: ast.FunctionDef) -> int:
    """Return the number of parameters of a function, without the instance or class of a method."""
    arguments = function.args
    names = [argument.arg for argument in (*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def _body_lines(function: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    body = function.body[ast.get_docstring(function) is not None :]
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def assigned(nodes: Iterable[ast.AST]) -> Iterator[tuple[str, int]]:
    """Names of variables that are assigned, with their lines: by ``=``, ``for``, ``with``, ``:=`` and as parameters."""
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno


def _uses_of_alias(nodes: list[ast.AST]) -> int:
    """Count uses of the alias of ``dict[str, Any]``, where a module imports or defines it."""
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module != SHOWN_TABLE]
    is_there = any(entry.name == ALIAS for node in imports for entry in node.names)
    is_there |= any(isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == ALIAS for node in nodes)
    return sum(isinstance(node, ast.Name) and node.id == ALIAS for node in nodes) if is_there else 0


def _constant_docstrings(node: ast.AST) -> int:
    body = getattr(node, "body", None)
    pairs = itertools.pairwise(body) if isinstance(body, list) else ()
    return sum(
        isinstance(first, ast.Assign | ast.AnnAssign)
        and isinstance(second, ast.Expr)
        and isinstance(second.value, ast.Constant)
        and isinstance(second.value.value, str)
        for first, second in pairs
    )


def _module(path: Path, package: Path) -> str:
    parts = path.relative_to(package.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _room(module: str) -> str:
    return module.split(".")[1] if "." in module else ""


def _imports(name: str, nodes: Iterable[ast.AST], modules: Collection[str]) -> set[str]:
    """Modules of the package that a module imports, at its top or deferred; not for types alone."""
    targets: set[str] = set()
    typing_only = {
        id(inner)
        for node in nodes
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        for inner in ast.walk(node)
    }
    for node in nodes:
        if id(node) in typing_only:
            continue
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                targets.add(full if full in modules else node.module)
        elif isinstance(node, ast.Import):
            targets.update(alias.name for alias in node.names)
    return {target for target in targets if target in modules and target != name}


def _depth(room: str, rooms: dict[str, set[str]], above: tuple[str, ...]) -> int:
    below = rooms[room] - {room, *above}
    return 1 + max((_depth(one, rooms, (*above, room)) for one in below), default=0) if len(above) < len(rooms) else 0


def _circles(imports: dict[str, set[str]]) -> list[list[str]]:
    """Strongly connected groups (Tarjan 1972), without recursion."""
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    on_stack: set[str] = set()
    groups: list[list[str]] = []
    for root in imports:
        if root in index:
            continue
        work = [(root, iter(imports[root]))]
        index[root] = low[root] = len(index)
        stack.append(root)
        on_stack.add(root)
        while work:
            name, following = work[-1]
            step = next(following, None)
            if step is None:
                work.pop()
                if work:
                    low[work[-1][0]] = min(low[work[-1][0]], low[name])
                if low[name] == index[name]:
                    cut = stack.index(name)
                    groups.append(stack[cut:])
                    on_stack.difference_update(stack[cut:])
                    del stack[cut:]
            elif step not in index:
                index[step] = low[step] = len(index)
                stack.append(step)
                on_stack.add(step)
                work.append((step, iter(imports[step])))
            elif step in on_stack:
                low[name] = min(low[name], index[step])
    return groups


def _processor_seconds(target: str) -> float:
    """Processor time of a make target and its child processes.

    Raises:
        SystemExit: the target fails; says what it printed at last.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    done = subprocess.run(["make", target], cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if done.returncode:
        raise SystemExit(f"make {target} failed, so its time says nothing:\n{(done.stdout + done.stderr)[-3000:]}")
    return seconds


@benchmark()
def main(bench: Bench) -> object:
    house = measure()
    lines = sum(path.read_text(encoding="utf-8").count("\n") for path in Path(__file__).parent.glob("*.py"))
    figures = (
        ("modules and packages at the top level", len(house.siblings), 23),
        ("import relations between packages", house.arrows, 141),
        ("import cycles", len(house.circles), 0),
        (f"functions of more than {MAX_PARAMETERS} parameters", len(house.wide_functions), 0),
        (f"files of more than {LONG_FILE} lines", len(house.long_files), 0),
        ("duplicate public class names", len(house.duplicates), 0),
        ("variables with a banned name", len(house.banned), 0),
        ("lines of src", house.lines, LINES_BEFORE - 4_500),
        ("lines of templates", house.templates, 600),
        ("lines of benchmarks", lines, 11_500),
        ("uses of dict[str, Any], Mapping[str, Any] and their alias", house.open_dictionaries, 250),
        ("percent of functions with a body of two lines or fewer", house.short_bodies, 15),
    )
    rows: list[tuple[object, ...]] = [(name, value, f"<= {bound}") for name, value, bound in figures]
    rows += [("floors", house.floors, ""), ("modules", house.modules, "")]
    rows += [("comments per 100 lines", house.comments, ">= 3"), ("docstrings per 100 lines", house.docstrings, "")]
    for n, v, b in figures:
        bench.check(n, v, b, "<= 1" if b else "<= 0", "count")
    bench.check("comments per 100 lines", house.comments, 3.0, ">= 1", "comments")
    if not bench.quick:
        for target, bound in (("check", 120.0), ("test", 600.0)):
            seconds = _processor_seconds(target)
            rows.append((f"make {target}, processor seconds", seconds, f"<= {bound:g}"))
            bench.check(f"make {target}", seconds, bound, "<= 1", "s")
    table(("figure", "now", "bound"), rows)
    for line in (*house.circles, *house.wide_functions, *house.long_files, *house.duplicates, *house.banned[:40]):
        print("  ", line)
    return {"floors": house.floors, "modules": house.modules}


if __name__ == "__main__":
    main()
