"""Environment of this process and of its children, set before NumPy and torch are loaded.

One thread each: a second thread waits for its part of the work in a busy loop, which costs more than arrays as small as
those of tests. No size of a terminal: `COLUMNS` and `LINES` of the caller would fold what commands print.
"""

from __future__ import annotations

import os

for library in ("OMP", "MKL", "OPENBLAS"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
for size in ("COLUMNS", "LINES"):
    os.environ.pop(size, None)
