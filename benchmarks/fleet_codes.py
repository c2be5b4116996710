"""Is a network with a code for each machine better on a machine that it never saw than one without?

Both are pretrained on the 200 machines of `benchmarks/foundation.py` (those of 12 to 17 t held out), with the same
settings and as many updates: `edp pretrain --method codes`, whose network reads a few numbers that say which machine it
is, and `--method joint`, the rival. The target is the worn C14. With some minutes of its logs `edp finetune --method
code` finds its code and changes nothing else; the rival has the same minutes for all of its weights (`--method full`,
as many updates), or goes as it is.

Every training is a run below ``--work``, so that a stopped benchmark goes on; that of the rival is the one of
`benchmarks/foundation.py` where both have the same folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from common import Verdict, finish, in_folder, parser, table, verdict
from foundation import MINUTES, STARTS, Bench, after_minutes, zero_shot

WAYS = (("family", "full"), ("codes", "code"), ("codes", "full"))
"""Start and method of fine-tuning."""


def judge(bench: Bench) -> None:
    """Train, fine-tune, print and judge."""
    quick = bench.quick
    minutes = MINUTES[:1] if quick else MINUTES
    as_it_is = {name: row["mae"] for name, row in zero_shot(bench, ["family", "codes"], "c14").items()}
    errors: dict[str, dict[str, float]] = {}
    for start, method in WAYS:
        tuned = {str(m): after_minutes(bench, start, m, method)["mae"] for m in minutes}
        errors[f"{start}, {method}"] = {"0": as_it_is[start]} | tuned
    print("C14 after some minutes of its logs, k = 10, mm/s")
    rows: list[list[Any]] = [
        [f"{STARTS[key.split(',')[0]]},{key.split(',')[1]}", *row.values()] for key, row in errors.items()
    ]
    table(["start, method", "0 min", *(f"{m} min" for m in minutes)], rows)
    last, code = str(minutes[-1]), errors["codes, code"]
    told = f"{last} min of C14, a code"
    verdicts: list[Verdict] = [
        verdict(
            f"{told} / the network without codes, as it is", code[last], as_it_is["family"], "<= 0.85", "mm/s", quick
        ),
        verdict(
            f"{told} / all weights of the network without codes",
            code[last],
            errors["family, full"][last],
            "<= 1",
            "mm/s",
            quick,
        ),
        verdict("no logs of C14, with codes / without", as_it_is["codes"], as_it_is["family"], "<= 1", "mm/s", quick),
    ]
    finish("fleet_codes", verdicts, bench.seed, errors)


def main() -> None:
    """Command line."""
    options = parser(__doc__ or "")
    options.add_argument(
        "--work", type=Path, default=None, help="folder of runs and results; a stopped benchmark goes on"
    )
    chosen = options.parse_args()
    torch.set_num_threads(1)
    in_folder(chosen.work, lambda work: judge(Bench(work, chosen.data or work / "data", chosen.seed, chosen.quick)))


if __name__ == "__main__":
    main()
