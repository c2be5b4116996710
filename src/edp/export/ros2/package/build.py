"""Compiles the C code: ``python -m PACKAGE.build`` or, while the package is built, by setup.py."""

import os

from .core import build

if __name__ == "__main__":
    print(build(os.environ.get("CC", "cc")))
