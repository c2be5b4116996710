"""No text of a file is ever evaluated: shown on the source, and on what Python does while hostile files are read."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import edp

SOURCE = Path(edp.__file__).parent
BUILTINS = {"eval", "exec", "compile", "__import__", "breakpoint", "input"}
MODULES = {"pickle", "cPickle", "_pickle", "dill", "cloudpickle", "marshal", "shelve", "joblib", "code", "codeop"}
MODULES |= {"runpy", "numexpr", "sympy", "xml.dom", "xml.sax"}
"""Modules that unpickle, run text, or follow external entities."""
CALLS = {
    ("os", "system"), ("os", "popen"), ("subprocess", "getoutput"), ("subprocess", "getstatusoutput"),
    ("yaml", "load"), ("yaml", "unsafe_load"), ("yaml", "full_load"), ("pd", "eval"), ("pandas", "eval"),
    ("np", "fromregex"), ("tempfile", "mktemp"),
}  # fmt: skip
"""Functions that run text, or a shell, or race for a file's name."""


def findings(text: str) -> list[str]:
    """What a source file does that could run text: ``line: what``."""
    tree, seen = ast.parse(text), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import | ast.ImportFrom):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else [alias.name for alias in node.names]
            seen += [f"{node.lineno}: import {name}" for name in names if MODULES & {name, name.split(".")[0]}]
        if not isinstance(node, ast.Call):
            continue
        called = node.func
        if isinstance(called, ast.Name) and called.id in BUILTINS:
            seen.append(f"{node.lineno}: {called.id}()")
        if isinstance(called, ast.Attribute) and isinstance(called.value, ast.Name):
            if (called.value.id, called.attr) in CALLS:
                seen.append(f"{node.lineno}: {called.value.id}.{called.attr}()")
            if (called.value.id, called.attr) == ("torch", "load") and not _given(node, "weights_only", True):
                seen.append(f"{node.lineno}: torch.load() without weights_only")
            if any(word.arg == "allow_pickle" for word in node.keywords) and not _given(node, "allow_pickle", False):
                seen.append(f"{node.lineno}: {called.attr}() that may unpickle")
        if any(word.arg == "shell" for word in node.keywords):
            seen.append(f"{node.lineno}: a call with shell=")
    return seen


def _given(call: ast.Call, name: str, value: object) -> bool:
    given = [word.value for word in call.keywords if word.arg == name]
    return len(given) == 1 and isinstance(given[0], ast.Constant) and given[0].value is value


OF_THE_PARENT = ("jobs/processes.py", "jobs/worker.py")
"""A worker unpickles the jobs that the process which started it sends through its own socket; nothing from a file."""


def test_no_module_runs_text_unpickles_or_starts_a_shell():
    files = sorted(SOURCE.rglob("*.py"))
    assert len(files) > 400
    seen = {str(file.relative_to(SOURCE)): findings(file.read_text(encoding="utf-8")) for file in files}
    assert {name: lines for name, lines in seen.items() if lines and name not in OF_THE_PARENT} == {}
    assert all(seen[name] for name in OF_THE_PARENT)


@pytest.mark.parametrize(
    "text",
    [
        "eval('1')",
        "exec(text)",
        "import pickle",
        "from pickle import loads",
        "import os\nos.system('true')",
        "subprocess.run('true', shell=True)",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "np.load(path, allow_pickle=True)",
        "yaml.load(text)",
        "__import__('os')",
    ],
)
def test_the_search_finds_what_it_is_for(text):
    assert len(findings(text)) == 1
    assert findings("network.eval()\nre.compile('a')\nnp.load(path)") == []
