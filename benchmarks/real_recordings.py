"""Our default on public measured recordings, beside persistence and linear floors, k steps ahead.

Each set is a data-set file and a settings file in ``examples/real``; no code knows any of them. The same commands, with
the same defaults, work on anyone's recordings:

    edp train examples/real/faster.toml --config examples/real/faster_settings.toml --out runs/faster
    edp evaluate runs/faster

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import Verdict, finish, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.settings.tree import read_toml
from edp.storage import read_json
from edp.workflows.auto import load_auto, train_auto, usual_preset
from edp.workflows.train_evaluate import DataSource, evaluate, train

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples" / "real"
VARIABLE = "EDP_SHARED_DATA"
PRESET = "auto"
OWN_NETWORK = "small"
"""Preset under settings that name a network of their own."""
BASELINES = ("persistence", "ridge_arx")
QUICK_SETS = ("sjoberg.toml", "tanks.toml")
QUICK = ("auto.minutes=0.05",)


@dataclass(frozen=True)
class Row:
    """Root-mean-square errors of one target at one horizon, in the units of the floors.

    Attributes:
        ours: of the network.
        ridge: of the ridge regression on the network's own training part.
        persistence: of persistence, in this run.
        floor_persistence: as stated with the data.
        floor_linear: as stated with the data.
    """

    title: str
    target: str
    horizon: int
    ours: float
    ridge: float
    persistence: float
    floor_persistence: float
    floor_linear: float


def scores_of(data: str, settings: str, out: Path, changes: Sequence[str]) -> tuple[dict[str, Any], float]:
    """Train and judge by a data-set file and a settings file; the content of scores.json, and seconds."""
    began = time.perf_counter()
    source, file = DataSource.of(EXAMPLES / data), EXAMPLES / settings
    if usual_preset(file, changes) == PRESET:
        train_auto(source, load_auto(file, changes), out)
    else:  # settings of the network: those of free runs lie over the preset for little data
        train(source, load_experiment(file, OWN_NETWORK, changes), out)
    folder = evaluate(out, baselines=BASELINES)
    return read_json(folder / "scores.json"), time.perf_counter() - began


def rmse(scores: dict[str, Any], model: str, target: str, horizon: int) -> float:
    """Root-mean-square error of a model in report units."""
    return float(scores["models"][model]["overall"][str(horizon)][target]["rmse"])


def floor_rows(entry: dict[str, Any], scores: dict[str, Any]) -> Iterator[Row]:
    """A row for each stated floor of a set."""
    for target, horizon, persistence, linear in entry["rows"]:
        ours, ridge, held = (rmse(scores, model, target, horizon) for model in ("network", "ridge_arx", "persistence"))
        yield Row(entry["title"], target, horizon, ours, ridge, held, persistence, linear)


def verdicts_of(rows: Sequence[Row], quick: bool) -> list[Verdict]:
    """Ours against the linear floor, row by row."""
    return [
        verdict(f"{r.title}: {r.target}, k = {r.horizon}", r.ours, r.floor_linear, "<= 1", "RMSE", quick) for r in rows
    ]


def show_floors(rows: Sequence[Row], quick: bool) -> None:
    """Print the k-step table."""
    print(f"\nRMSE k steps ahead, preset '{PRESET}'" + (" (quick: hardly trained)" if quick else ""))
    headings = ["set", "target", "k", "ours", "linear floor", "ridge here", "persistence", "stated", "ours/floor"]
    lines = []
    for r in rows:
        held = (r.floor_linear, r.ridge, r.persistence, r.floor_persistence, r.ours / r.floor_linear)
        lines.append([r.title, r.target, r.horizon, r.ours, *held])
    table(headings, lines)


def run(quick: bool, seed: int) -> tuple[list[Row], dict[str, Any]]:
    """Train and judge every set; rows of the k-step table and what else is kept."""
    listed = read_toml(EXAMPLES / "leagues.toml")
    changes = [f"auto.seed={seed}", *(QUICK if quick else ())]
    rows: list[Row] = []
    kept: dict[str, Any] = {"seconds": {}}
    with tempfile.TemporaryDirectory() as folder:
        for entry in listed["floors"]:
            if quick and entry["data"] not in QUICK_SETS:
                continue
            print(f"{entry['settings']} ...", file=sys.stderr, flush=True)
            out = Path(folder) / Path(entry["settings"]).stem
            scores, seconds = scores_of(entry["data"], entry["settings"], out, changes)
            kept["seconds"][entry["settings"]] = round(seconds, 1)
            rows += floor_rows(entry, scores)
    return rows, kept


def shared_folder(given: Path | None) -> Path | None:
    """The folder of the recordings, made known to data-set files; None, and a line says so, where there is none."""
    shared = given or Path(os.environ.get(VARIABLE) or ROOT.parent / "shared" / "data")
    if not shared.is_dir():
        print(f"skipped: there is no folder of real recordings '{shared}'; give --shared or set {VARIABLE}")
        print(json.dumps({"skipped": True, "why": "no real recordings"}))
        return None
    os.environ[VARIABLE] = str(shared.resolve())
    return shared


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    options = parser(__doc__ or "")
    options.add_argument("--shared", type=Path, default=None, help=f"folder of the recordings (else ${VARIABLE})")
    given = options.parse_args(arguments)
    if shared_folder(given.shared) is None:
        return
    rows, kept = run(given.quick, given.seed)
    show_floors(rows, given.quick)
    kept["rows"] = [vars(row) for row in rows]
    finish("real_recordings", verdicts_of(rows, given.quick), given.seed, kept)


if __name__ == "__main__":
    main()
