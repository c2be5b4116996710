"""Commands that write, each on a disk that takes no file beyond a size: what they say, and what they leave."""

from __future__ import annotations

import contextlib
import io
import json
import resource
import signal
import sys
from pathlib import Path

import numpy as np

from edp.cli import app
from edp.cli.console import run_app
from edp.export import TARGETS
from edp.logs import write_recording
from edp.recording import Recording
from edp.signals import TABLE_A1

SETTINGS = (
    *("training.epochs=1", "training.updates=2", 'training.optimizer={kind="adamw"}', "model.window=12"),
    'training.chunks={regime="chunk",length=32,batch=4,burn_in=10}',
    *('model.backbone={kind="lstm",units=4}', "model.head.hidden=4", "evaluation.history=5"),
)
SMALL = ("--preset", "quick", *(word for change in SETTINGS for word in ("--set", change)))
LIMITS = {"export": (200, 2_000)}
"""Bytes that a file may have; the larger one lets the small files of an export through."""
FMU = ("--set", "binaries=none")


def write_logs(folder: Path) -> Path:
    for number in range(5):
        time_s, random = np.arange(600) / 100, np.random.default_rng(number)
        values = np.sin(2 * np.pi * random.uniform(0.1, 0.6, len(TABLE_A1)) * time_s[:, None])
        channels = tuple(TABLE_A1.values())
        recording = Recording(f"drive_{number}", channels, values.astype(np.float32), 100.0, source="test")
        write_recording(recording, folder / f"drive_{number}.parquet")
    return folder


def run(*args: object) -> tuple[int, str]:
    sys.argv = ["edp", *map(str, args)]
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        code = run_app(app)
    return code, " ".join(said.getvalue().replace("│", " ").split())


def commands(logs: Path, trained: Path, out: Path) -> dict[str, tuple[object, ...]]:
    """Return command lines by name; `out` is the folder that they write into."""
    exports = {
        f"export {form}": ("export", trained, "--to", form, *(FMU if form == "fmu" else ()), "--out", "")
        for form in TARGETS
    }
    plain = {
        "report": ("report", trained, "--out", "/page.html"),
        "inspect": ("inspect", logs, "--page", "/page.html"),
        "simulate": ("simulate", "", "--minutes", 0.1, "--recordings", 1, "--workers", 1),
        "store": ("store", "build", logs, "--workers", 1, "--out", ""),
        "init": ("init", logs, "--yes", "--out", ""),
        "screen": ("screen", logs, "--no-pictures", "--out", ""),
        "train": ("train", logs, *SMALL, "--out", ""),
    }
    return {
        name: tuple(f"{out}{word}" if word in ("", "/page.html") else word for word in words)
        for name, words in (exports | plain).items()
    }


def main(folder: Path) -> None:
    logs, trained = write_logs(folder / "logs"), folder / "trained"
    code, text = run("train", logs, *SMALL, "--out", trained)
    assert code == 0, text
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    told = []
    for name in commands(logs, trained, folder):
        for limit in LIMITS.get(name.split()[0], (200,)):
            out = folder / f"{limit} {name}"
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, resource.RLIM_INFINITY))
            try:
                code, text = run(*commands(logs, trained, out)[name])
            except BaseException as error:
                code, text = 0, f"Traceback {type(error).__name__}: {error}"
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
            left = {str(file.relative_to(out)): file.stat().st_size for file in out.rglob("*") if file.is_file()}
            told.append({"command": name, "limit": limit, "code": code, "said": text, "left": left})
    print(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
