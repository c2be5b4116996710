"""What must be settled before NumPy and torch are loaded, in this process and in its children: one thread each.

A second thread waits for its part of the work by running in circles; on arrays as small as those of tests this costs
more than the work.
"""

from __future__ import annotations

import os

for library in ("OMP", "MKL", "OPENBLAS"):
    os.environ.setdefault(f"{library}_NUM_THREADS", "1")
