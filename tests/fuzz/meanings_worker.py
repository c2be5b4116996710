"""Reads files with hostile meanings, one after the other: ``python meanings_worker.py FOLDER KIND[,KIND] FIRST COUNT``.

The last line is JSON: how many were read and refused, the most processor time of one, and what went wrong.
"""

from __future__ import annotations

import faulthandler
import json
import logging
import os
import shutil
import sys
import warnings
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))
import meanings
from worker import peak_mb

from edp.config.experiment import load_experiment
from edp.errors import EdpError
from edp.logs import inspect_log, read_recording
from edp.logs.source import load_signal_map
from edp.networks import Stream
from edp.sandbox import end
from edp.signals import SignalMap
from edp.training import load_bundle

SECONDS = 10.0
"""Of processor time that reading one file may take, this process and the readers together."""
HANGS_S = 120


def read(kind: str, path: Path) -> None:
    if kind == "settings":
        load_experiment(path)
    elif kind == "signal_map":
        load_signal_map(path)
    elif kind == "bundle":
        Stream(load_bundle(path).predictor)
    else:
        read_recording(path, SignalMap(others=True))
        inspect_log(path)


def processor_s() -> float:
    """Of this process, and of all those below it that have ended or run."""
    own, total = os.getpid(), 0.0
    tick = os.sysconf("SC_CLK_TCK")
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(entry.name) == own or int(fields[1]) == own:
                total += sum(map(int, fields[11:15])) / tick
    return total


def drawn(kind: str, number: int, place: Path) -> Path:
    """The file of a number; where a library will not write what was drawn, another is drawn."""
    for again in range(50):
        try:
            return meanings.MAKERS[kind](meanings.np.random.default_rng([number, again, *kind.encode()]), place)
        except Exception as error:
            print(f"{kind} {number}: {type(error).__name__}: {error}"[:200], file=sys.stderr)
            for rest in place.iterdir():
                if rest.name != "honest_bundle":
                    shutil.rmtree(rest) if rest.is_dir() else rest.unlink()
    raise RuntimeError(f"no file of kind {kind} could be written for number {number}")


def one(kind: str, number: int, folder: Path, found: dict[str, Any]) -> None:
    place = folder / "case"
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir()
    if kind == "bundle":
        shutil.copytree(meanings._bundle(folder), place / "honest_bundle")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the libraries that write the files
        path = drawn(kind, number, place)
    before, fault = processor_s(), ""
    faulthandler.dump_traceback_later(HANGS_S, exit=True)
    try:
        read(kind, path)
        found["read"] += 1
    except EdpError as error:
        found["refused"] += 1
        fault = "" if len(str(error)) < 25_000 else f"a message of {len(str(error))} characters"
    except BaseException as error:
        fault = f"{type(error).__name__}: {error}"
    faulthandler.cancel_dump_traceback_later()
    spent = processor_s() - before
    found["slowest_s"] = max(found["slowest_s"], spent)
    if spent > SECONDS:
        fault = f"{spent:.1f} s of processor time"
    if fault:
        found["faults"].append([number, fault[:400]])


def main() -> None:
    folder, kinds, first, count = Path(sys.argv[1]), sys.argv[2].split(","), int(sys.argv[3]), int(sys.argv[4])
    faulthandler.enable()
    logging.disable(logging.CRITICAL)
    os.chdir(folder)
    results: dict[str, Any] = {}
    for kind in kinds:
        results[kind] = {"read": 0, "refused": 0, "slowest_s": 0.0, "faults": []}
        for number in range(first, first + count):
            one(kind, number, folder, results[kind])
        print(kind, file=sys.stderr)
    end()
    results["peak_mb"] = peak_mb()
    results["marker"] = any(folder.rglob("marker"))
    print(json.dumps(results))


if __name__ == "__main__":
    main()
