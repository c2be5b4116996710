"""What does a data-set store save over logs: processor time to build, memory of a training, time of an update?

The logs hold random walks of 45 channels at 100 Hz in Parquet: memory and time do not depend on what the numbers mean.
A training runs as a user runs it, once on the logs and once on the store, each in a process of its own. Its memory is
what it holds beside files that the system may drop and read again (anonymous memory), looked at every 0.2 s.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import load_file

from common import finish, parser, table, verdict
from memory import CHANNELS, RATE_HZ, write_logs

GOAL_S_AN_HOUR = 3.0
"""Processor time of building a store for an hour of logs."""
GOAL_MB = 2048.0


def used_s() -> float:
    """Processor time of processes that ended, in s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def anonymous_mb(process: int) -> float:
    """Memory of a process that no file backs, in MB; 0 once it ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    except (OSError, ProcessLookupError):
        return 0.0
    return sum(float(line.split()[1]) / 1024 for line in lines if line.startswith("RssAnon:"))


def run(command: list[str]) -> tuple[float, float]:
    """Run `edp` to its end: processor time in s and most anonymous memory in MB."""
    before, peak = used_s(), 0.0
    with subprocess.Popen([sys.executable, "-m", "edp", *command, "--json"], stdout=subprocess.DEVNULL) as process:
        while process.poll() is None:
            peak = max(peak, anonymous_mb(process.pid))
            time.sleep(0.2)
    if process.returncode:
        raise SystemExit(f"edp {' '.join(command)} ended with {process.returncode}")
    return used_s() - before, peak


def training(data: Path, out: Path, updates: int) -> list[str]:
    """A training of the preset quick with so many updates an epoch."""
    sets = ["training.epochs=2", f"training.updates={updates}"]
    return ["train", str(data), "--out", str(out), "--preset", "quick", *(w for text in sets for w in ("--set", text))]


def main() -> None:
    arguments = parser(__doc__ or "").parse_args()
    hours, updates = (1.0, 20) if arguments.quick else (10.0, 300)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        write_logs(folder / "logs", hours, 20, arguments.seed)
        build_s, build_mb = run(
            ["store", "build", str(folder / "logs"), "--out", str(folder / "store"), "--workers", "1"]
        )
        logs_s, logs_mb = run(training(folder / "logs", folder / "from_logs", updates))
        store_s, store_mb = run(training(folder / "store", folder / "from_store", updates))
        weights = [load_file(next((folder / run).rglob("*.safetensors"))) for run in ("from_logs", "from_store")]
    same = all(np.array_equal(weights[0][name], weights[1][name]) for name in weights[0] | weights[1])
    rows = [
        ("build the store", build_s, build_mb),
        ("train on the logs", logs_s, logs_mb),
        ("train on the store", store_s, store_mb),
    ]
    table([f"{hours:g} h, {CHANNELS} channels, {RATE_HZ:g} Hz", "processor s", "anonymous memory, MB"], rows)
    print(f"weights of both trainings: {'the same bits' if same else 'NOT the same'}")
    quick = arguments.quick
    finish(
        "store",
        [
            verdict("processor time of building, an hour of logs", build_s / hours, GOAL_S_AN_HOUR, "<= 1", "s", quick),
            verdict(f"memory of training on a store of {hours:g} h", store_mb, GOAL_MB, "<= 1", "MB", quick),
            verdict("memory of training, store over logs", store_mb, logs_mb, "<= 0.5", "MB", quick),
            verdict("trainings with the same weights", float(same), 1.0, ">= 1", "", quick),
        ],
        arguments.seed,
        {"hours": hours, "rows": rows},
    )


if __name__ == "__main__":
    main()
