"""How much memory does training on a 10 h, 100 Hz, 45-channel data set take?

The logs hold random walks: memory does not depend on what the numbers mean. Training runs as a user runs it, in a
process of its own whose peak resident memory the operating system reports.
"""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import numpy as np

from common import Bench, benchmark
from edp.logs import write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1, Channel, Kind

RATE_HZ = 100.0
CHANNELS = 45
LIMIT_MB = 4096.0


def write_logs(folder: Path, hours: float, count: int, seed: int) -> None:
    """Write `count` Parquet logs of `hours` in all, with the 24 channels of Table A.1 and 21 others."""
    rng = np.random.default_rng(seed)
    extra = tuple(Channel(f"Extra_{i}", Kind.GENERIC) for i in range(CHANNELS - len(TABLE_A1)))
    channels = tuple(TABLE_A1.values()) + extra
    samples = int(hours * 3600 * RATE_HZ / count)
    for number in range(count):
        steps = rng.normal(size=(samples, CHANNELS)).astype(np.float32)
        values = np.cumsum(steps, axis=0, dtype=np.float64) * 0.01
        write_recording(
            Recording(f"log_{number:02d}", channels, values.astype(np.float32), RATE_HZ),
            folder / f"log_{number:02d}.parquet",
        )


@benchmark()
def main(bench: Bench) -> object:
    hours, updates = (1.0, 20) if bench.quick else (10.0, 300)
    folder = bench.folder
    write_logs(folder / "logs", hours, 20, bench.seed)
    sets = ["training.epochs=2", f"training.updates={updates}"]
    command = [sys.executable, "-m", "edp", "train", str(folder / "logs"), "--out", str(folder / "run")]
    command += ["--preset", "quick", "--json", *(word for text in sets for word in ("--set", text))]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    print(f"training on {hours:g} h of {CHANNELS} channels at {RATE_HZ:g} Hz: peak resident memory {peak:,.0f} MB")
    bench.check(f"peak memory of training on {hours:g} h", peak, LIMIT_MB, "<= 1", "MB")


if __name__ == "__main__":
    main()
