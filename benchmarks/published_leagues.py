"""How good are our free runs on public benchmarks, beside what others published for them?

The output is never read, but for a few first samples where the league allows them. Settings are in ``examples/real``;
whatever they choose was chosen within the training recording (tanks: blocked cross-validation; the others: its last
fifth), never on the test recording. Each set is trained with several seeds; the median counts, and the spread is shown.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from common import Verdict, finish, parser, table, verdict
from edp.config.experiment import read_toml
from real_recordings import EXAMPLES, VARIABLE, rmse, scores_of, shared_folder

QUICK_SETS = ("tanks.toml",)
QUICK = ("training.epochs=2", "training.updates=20", "training.refit=none")
RIDGE = "ridge on past inputs, here"


def free_run(entry: dict[str, Any], scores: dict[str, Any], model: str) -> float:
    """Free-run error of a model in the unit of the published ones."""
    if entry.get("integrated"):
        value = float(scores["models"][model]["integrated"][entry["target"]]["rmse"])
    else:
        value = rmse(scores, model, entry["target"], 0)
    return value * entry.get("factor", 1.0)


def measure(entry: dict[str, Any], seeds: Sequence[int], quick: bool) -> dict[str, Any]:
    """Our errors on a set, a figure a seed, and that of ridge regression."""
    found: dict[str, Any] = {"ours": {}, "seconds": {}}
    with tempfile.TemporaryDirectory() as folder:
        for seed in seeds:
            print(f"{entry['settings']}, seed {seed} ...", file=sys.stderr, flush=True)
            changes = (f"training.seed={seed}", *(QUICK if quick else ()))
            scores, seconds = scores_of(entry["data"], entry["settings"], Path(folder) / str(seed), changes)
            found["ours"][seed] = free_run(entry, scores, "network")
            found["seconds"][seed] = round(seconds, 1)
        found[RIDGE] = free_run(entry, scores, "ridge_arx")
        found["skip"] = scores["task"]["skip"]
        found["skip_s"] = scores["task"]["skip"] / scores["task"]["rate_hz"]
    found["median"] = statistics.median(found["ours"].values())
    return found


def show(entry: dict[str, Any], found: dict[str, Any], quick: bool) -> None:
    """Print the published league with our error in its place."""
    print(f"\nFree run: {entry['title']}" + (" (quick: hardly trained)" if quick else ""))
    both = [*entry["published"].items(), ("OURS", found["median"]), (RIDGE, found[RIDGE])]
    table(["method", "test RMSE"], sorted(both, key=lambda pair: pair[1]))
    each = ", ".join(f"{value:.4g}" for value in found["ours"].values())
    print(f"Ours by seed: {each}. Source: {entry['source']}; {entry['note']}.")
    print(f"The first {found['skip']} ticks ({found['skip_s']:g} s) start ours and are not scored.")


def verdicts_of(entry: dict[str, Any], found: dict[str, Any], quick: bool, model: str = "") -> list[Verdict]:
    """Ours against each rival that the entry names; `model`: what the title adds where ours is not the default."""
    return [
        verdict(
            f"{entry['title']}{model}: against the published {name}",
            found["median"],
            entry["published"][name],
            "<= 1",
            entry["unit"],
            quick,
        )
        for name in entry["rivals"]
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    options = parser(__doc__ or "")
    options.add_argument("--shared", type=Path, default=None, help=f"folder of the recordings (else ${VARIABLE})")
    options.add_argument("--seeds", type=int, default=5)
    given = options.parse_args(arguments)
    if shared_folder(given.shared) is None:
        return
    verdicts: list[Verdict] = []
    kept: dict[str, Any] = {}
    for entry in read_toml(EXAMPLES / "leagues.toml")["leagues"]:
        if given.quick and entry["data"] not in QUICK_SETS:
            continue
        seeds = range(given.seed, given.seed + (1 if given.quick else given.seeds))
        found = measure(entry, seeds, given.quick)
        show(entry, found, given.quick)
        verdicts += verdicts_of(entry, found, given.quick)
        kept[entry["title"]] = found
    finish("published_leagues", verdicts, given.seed, kept)


if __name__ == "__main__":
    main()
