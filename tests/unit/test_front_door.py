"""``import edp``: lazy, and what it offers is what its page and its types say."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

import edp

pytestmark = pytest.mark.processes

HEAVY = ("torch", "numpy", "pandas", "polars", "scipy", "plotly", "matplotlib", "pyarrow", "edp.workflows")


def test_import_edp_imports_nothing_heavy():
    program = f"import sys, edp; dir(edp); print([name for name in {HEAVY} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


def test_a_frame_library_is_imported_only_where_it_is_asked_for():
    program = (
        "import sys, edp\n"
        "data = edp.Recordings.from_arrays([[[1.0], [2.0]]], rate_hz=1)\n"
        "data.to_numpy(), data._repr_html_()\n"
        "print([name for name in ('pandas', 'polars') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.parametrize("name", edp.__all__)
def test_every_public_name_is_there_and_explained(name):
    part = getattr(edp, name)
    assert name in dir(edp)
    assert name == "__version__" or (part.__doc__ or "").strip()


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'edp' has no attribute 'trian'"):
        edp.trian  # noqa: B018
    with pytest.raises(ImportError):
        from edp import nothing_of_this_name  # noqa: F401


def test_the_stub_states_every_public_name():
    tree = ast.parse(Path(edp.__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    imported = {alias.asname for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
    assert imported | {"__version__"} == set(edp.__all__)
