"""Notebooks: run cell by cell without a notebook server, and shown as Markdown pages.

A cell of lines that begin with ``!`` holds command lines, as in Jupyter; ``!edp ...`` runs in a process of its own.

``python -m edp_site.notebooks FILE...`` runs notebooks and writes what their cells gave into them.
"""

from __future__ import annotations

import ast
import base64
import contextlib
import io
import json
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

Notebook = dict[str, Any]
_NOTEBOOK_LINK = re.compile(r"(\]\([\w/.-]+)\.ipynb([#)])")
PICTURE_DPI = 72
"""Small pictures keep a notebook with five of them below 200 kB."""


def read_notebook(path: Path) -> Notebook:
    """Read a notebook of format 4.

    Raises:
        ValueError: it is none.
    """
    notebook = json.loads(path.read_text(encoding="utf-8"))
    if notebook.get("nbformat") != 4:
        raise ValueError(f"{path} is no notebook of format 4")
    return notebook  # type: ignore[no-any-return]


def source_of(cell: dict[str, Any]) -> str:
    """Text of a cell."""
    source = cell["source"]
    return source if isinstance(source, str) else "".join(source)


def run_notebook(path: Path, folder: Path) -> Notebook:
    """Run the cells of a notebook one after the other in one name space, and keep their texts and figures.

    Args:
        path: of the notebook, which is not written.
        folder: working directory of the cells.

    Raises:
        RuntimeError: a cell failed; says which.
    """
    notebook = read_notebook(path)
    space: dict[str, Any] = {"__name__": "__main__"}
    with _inside(folder):
        for number, cell in enumerate(cell for cell in notebook["cells"] if cell["cell_type"] == "code"):
            try:
                cell["outputs"] = _run_cell(source_of(cell), space)
            except Exception as error:
                raise RuntimeError(f"{path.name}, code cell {number + 1}: {type(error).__name__}: {error}") from error
            cell["execution_count"] = number + 1
    return notebook


@contextlib.contextmanager
def _inside(folder: Path) -> Iterator[None]:
    before = Path.cwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def command_lines(source: str) -> list[str]:
    """Return the command lines of a shell cell; a cell of Python has none."""
    lines = [line for line in source.splitlines() if line.strip()]
    return [line[1:].strip() for line in lines] if all(line.startswith("!") for line in lines) else []


def run_line(line: str) -> str:
    """Run a command line and return what it prints; exit code 6 of a comparison with baselines is no failure.

    Raises:
        RuntimeError: the command failed.
    """
    called = re.sub(r"^edp ", f"{sys.executable} -m edp ", line)
    place = os.pathsep.join(part for part in sys.path if part)
    environment = {**os.environ, "PYTHONPATH": place, "COLUMNS": "100", "TERM": "dumb"}
    done = subprocess.run(called, shell=True, env=environment, capture_output=True, text=True, check=False)
    allowed = {
        "edp evaluate": (0, 6),
        "edp train": (0, 6),
        "edp twin": (0, 6),
        "edp monitor run": (0, 5),
        "edp data check": (0, 3),
    }
    if done.returncode not in next((codes for words, codes in allowed.items() if line.startswith(words)), (0,)):
        raise RuntimeError(f"{line}: exit code {done.returncode}\n{(done.stdout + done.stderr)[-3000:]}")
    return done.stdout.replace(f"{Path.cwd()}/", "").replace(str(Path.cwd()), ".")


def _run_cell(source: str, space: dict[str, Any]) -> list[dict[str, Any]]:
    if lines := command_lines(source):
        return [{"output_type": "stream", "name": "stdout", "text": _lines("".join(map(run_line, lines)))}]
    import matplotlib

    matplotlib.use("agg")
    tree = ast.parse(source)
    # As a notebook does: the value of an expression at the end of a cell is shown.
    last = (
        tree.body.pop()
        if tree.body and isinstance(tree.body[-1], ast.Expr) and not source.rstrip().endswith(";")
        else None
    )
    printed = io.StringIO()
    value = None
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, "<cell>", "exec"), space)
        if isinstance(last, ast.Expr):
            value = eval(compile(ast.Expression(last.value), "<cell>", "eval"), space)
    outputs: list[dict[str, Any]] = []
    if text := printed.getvalue():
        outputs.append({"output_type": "stream", "name": "stdout", "text": _lines(text)})
    if value is not None:
        data = {"text/plain": _lines(repr(value))} | _picture_of(value)
        outputs.append({"output_type": "execute_result", "execution_count": None, "metadata": {}, "data": data})
    return outputs + _pictures()


def _picture_of(value: Any) -> dict[str, str]:
    """Return the picture that a value shows of itself in a notebook, by its type; empty if it has none."""
    bundle = getattr(value, "_repr_mimebundle_", None)
    shown = bundle() if callable(bundle) else {}
    return {"image/png": shown["image/png"] + "\n"} if "image/png" in shown else {}


def _pictures() -> list[dict[str, Any]]:
    """Open figures as PNG; they are closed."""
    from matplotlib import pyplot

    outputs = []
    for number in pyplot.get_fignums():
        drawn = io.BytesIO()
        figure = pyplot.figure(number)
        figure.savefig(drawn, format="png", dpi=PICTURE_DPI, bbox_inches="tight", metadata={"Software": None})
        pyplot.close(figure)
        data = {"image/png": base64.b64encode(drawn.getvalue()).decode("ascii") + "\n", "text/plain": ["<Figure>"]}
        outputs.append({"output_type": "display_data", "metadata": {}, "data": data})
    return outputs


def _lines(text: str) -> list[str]:
    return text.splitlines(keepends=True)


def notebook_page(path: Path, pictures: Path) -> str:
    """Return a notebook as Markdown: cells with the outputs of their last run.

    Args:
        path: of the notebook.
        pictures: folder beside the page that its pictures are written to.
    """
    parts: list[str] = []
    for cell in read_notebook(path)["cells"]:
        if cell["cell_type"] == "markdown":
            parts += [_NOTEBOOK_LINK.sub(r"\1.md\2", source_of(cell)), ""]
            continue
        if lines := command_lines(source_of(cell)):
            parts += ["```sh", *lines, "```", ""]
        else:
            parts += ["```python", source_of(cell).rstrip("\n"), "```", ""]
        for output in cell.get("outputs", []):
            parts += _shown(output, path.stem, pictures)
    parts += [f"This page is the notebook `docs/tutorials/{path.name}`; `pip install jupyterlab` opens it.", ""]
    return "\n".join(parts)


def _shown(output: dict[str, Any], stem: str, pictures: Path) -> list[str]:
    data = output.get("data", {})
    if "image/png" in data:
        pictures.mkdir(parents=True, exist_ok=True)
        name = f"{stem}_{len(list(pictures.glob(f'{stem}_*.png'))) + 1}.png"
        (pictures / name).write_bytes(base64.b64decode("".join(data["image/png"])))
        return [f"![What the cell above draws]({pictures.name}/{name})", ""]
    text = "".join(output.get("text", data.get("text/plain", "")))
    return ["```text", text.rstrip("\n"), "```", ""] if text.strip() else []


def main(paths: Sequence[str]) -> None:
    """Run notebooks and keep their outputs in the files."""
    for name in paths:
        path = Path(name).resolve()
        with tempfile.TemporaryDirectory() as folder:
            notebook = run_notebook(path, Path(folder))
        path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
        print(f"{name}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    main(sys.argv[1:])
