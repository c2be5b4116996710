"""How long does a whole screening take, how much memory, and how does it compare with a plain loop over libraries?

One hour of a simulated M22 at 100 Hz: the 24 channels of Table A.1, 16 further ones and 80 decoys, in 12 recordings.
The screening runs in a process of its own, whose peak memory the operating system reports; reading the logs is part of
it.

The rival makes the same figures from the same rows with scikit-learn and SciPy, a pair after another: pearsonr and
spearmanr over all rows, kendalltau and mutual_info_regression of the same sample, correlate of every pair in every
piece, all of these again in every piece and between pieces, and the same forest, predicting anew for each permutation.
Of each kind of call it makes an evenly spread share, and the time is scaled up (`--whole` makes them all). Linear
values, leaks and copies have no counterpart there: only ours does that work.

Times are compared as processor time, since ours uses every processor and the rival one.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.signal import correlate
from scipy.stats import kendalltau, pearsonr, spearmanr
from sklearn.ensemble import RandomForestRegressor
from sklearn.feature_selection import mutual_info_regression
from threadpoolctl import threadpool_limits

from common import DATA, Bench, benchmark, option, table
from decoys import lay_decoys
from edp.data.screening import ScreeningSpec, screen
from edp.data.screening.forest import rows_of
from edp.data.screening.stability import piece_rows
from edp.data.screening.table import CandidateTable, build_table
from edp.data.screening.values import choose_held_out
from edp.logs import read_data_set, write_recording
from edp.signals import TABLE_A1
from edp.workflows.train_evaluate import SimulationOrder, simulate_data_set

RECORDINGS = 12
CHANNELS = 120
SECONDS, MEGABYTES, SHARE = 180.0, 4096.0, "<= 0.2"
Call = Callable[[], float]


def make_logs(folder: Path, minutes: float, each: int, seed: int) -> None:
    """Simulate logs with decoys; reuse those of an earlier run."""
    if (folder / "made.json").exists():
        return
    simulated = folder.parent / f"{folder.name}_simulated"
    if not (simulated / "data_set.json").exists():
        simulate_data_set(simulated, SimulationOrder(minutes=minutes, recordings=RECORDINGS, seed=seed))
    recordings = read_data_set(simulated)
    moving = {c.name for c in recordings[0].channels if any(np.ptp(r.column(c.name)) > 0 for r in recordings)}
    names = [c.name for c in recordings[0].channels if c.name in TABLE_A1 or c.name in moving]
    names = names[: CHANNELS - 4 * each] if each == 20 else list(TABLE_A1)
    picked = [
        replace(r, values=r.select(names), channels=tuple(r.channels[r.index(name)] for name in names))
        for r in recordings
    ]
    folder.mkdir(parents=True, exist_ok=True)
    laid, decoys = lay_decoys(picked, each, seed)
    for recording in laid:
        write_recording(recording, folder / f"{recording.name}.parquet")
    (folder / "made.json").write_text(json.dumps([asdict(decoy) for decoy in decoys]))


def ours(folder: Path, out: Path) -> None:
    """Read the logs and screen them; figures and times go to a file."""
    began, busy = time.perf_counter(), time.process_time()
    shown = [""]

    def progress(stage: str, share: float) -> None:
        if stage != shown[0]:
            print(f"  {100 * share:3.0f} %  {stage}", flush=True)
            shown[0] = stage

    found = screen(read_data_set(folder), ScreeningSpec(), progress)
    took = {"wall_s": time.perf_counter() - began, "processor_s": time.process_time() - busy}
    out.write_text(json.dumps({**took, "found": found.to_json()}))


class Rival:
    """The same figures by library calls, an evenly spread share of each kind."""

    def __init__(self, data: CandidateTable, found: dict[str, Any], share: float) -> None:
        self.data, self.found, self.share = data, found, share
        self.spec = ScreeningSpec()
        self.live = [int(i) for i in np.flatnonzero(data.live)]
        self.rows: list[list[object]] = []
        self.seconds = 0.0

    def stage(self, name: str, calls: Sequence[tuple[Callable[[], Any], Any]], exact: bool = True) -> None:
        """Time a share of the calls, scale up, and compare each result with ours."""
        count = max(min(len(calls), 20), round(self.share * len(calls)))
        chosen = np.unique(np.linspace(0, len(calls) - 1, count).astype(int))
        began = time.process_time()
        theirs = [calls[i][0]() for i in chosen]
        seconds = (time.process_time() - began) * len(calls) / len(chosen)
        gaps = np.concatenate([np.abs(np.ravel(t - calls[i][1])) for t, i in zip(theirs, chosen, strict=True)])
        self.seconds += seconds
        self.rows.append([name, len(calls), len(chosen), seconds, float(np.median(gaps)), float(gaps.max())])

    def pairs(self) -> list[tuple[int, int]]:
        return [(i, j) for i in self.live for j in self.live if i > j]

    def matrix(self, name: str) -> np.ndarray:
        return np.array(self.found["matrices"][name], dtype=float)

    def matrices(self) -> None:
        """Dependencies at one instant."""
        whole = np.concatenate([s for piece in self.data.pieces for s in piece.stretches]).astype(np.float64)
        columns = [np.ascontiguousarray(whole[:, i]) for i in range(whole.shape[1])]
        del whole
        for name, call in (("pearson", pearsonr), ("spearman", spearmanr)):
            known = self.matrix(name)
            calls = [
                (lambda i=i, j=j, call=call: call(columns[i], columns[j]).statistic, known[i, j])
                for i, j in self.pairs()
            ]
            self.stage(f"{name}, all rows", calls)
        known, sample = self.matrix("kendall"), self.data.sample(self.spec.rank_samples).astype(np.float64)
        calls = [
            (lambda i=i, j=j: kendalltau(sample[:, i], sample[:, j]).statistic, known[i, j]) for i, j in self.pairs()
        ]
        self.stage(f"kendall, {len(sample)} rows", calls)
        known, few = self.matrix("information"), self.data.sample(self.spec.information_samples).astype(np.float64)
        calls = [(lambda i=i, j=j: informed(few[:, i], few[:, j]), known[i, j]) for i, j in self.pairs()]
        self.stage(f"mutual information, {len(few)} rows", calls)

    def lags(self) -> None:
        """Cross-correlation of every pair, over all pieces; those with a target are compared with our curves."""
        reach = self.spec.max_lag
        curves = {(c["channel"], c["target"]): np.array(c["correlation"]) for c in self.found["lags"]}
        centred = [
            [(s - self.data.sums[0][p]).astype(np.float64) for s in piece.stretches]
            for p, piece in enumerate(self.data.pieces)
        ]

        def curve(i: int, j: int) -> np.ndarray:
            total, squares = np.zeros(2 * reach + 1), np.zeros(2)
            for stretches in centred:
                for x in stretches:
                    found, middle = correlate(x[:, i], x[:, j], method="fft"), len(x) - 1
                    total += found[middle - reach : middle + reach + 1]
                    squares += (x[:, i] @ x[:, i], x[:, j] @ x[:, j])
            return total / np.sqrt(squares.prod())

        names, targets = self.data.names, self.data.targets
        shown = [(lambda i=i, j=j: curve(i, j), curves[names[i], names[j]]) for i in self.live for j in targets]
        self.stage("lag curves of targets", shown)
        rest = [(i, j) for i, j in self.pairs() if j not in targets and i not in targets]
        self.stage("lag curves of other pairs", [(lambda i=i, j=j: 0 * curve(i, j).max(), 0.0) for i, j in rest])

    def stability(self) -> None:
        """Compute the four metrics for each segment, and between segments."""
        rows = [piece_rows(self.data, p, self.spec) for p in range(len(self.data.pieces))]
        values = {(s["metric"], s["channel"], s["target"]): s["values"] for s in self.found["stability"]}
        metrics = {
            "pearson": lambda x, y: pearsonr(x, y).statistic,
            "spearman": lambda x, y: spearmanr(x, y).statistic,
            "kendall": lambda x, y: kendalltau(x, y).statistic,
            "information": informed,
        }
        for name, metric in metrics.items():
            own, crossed = [], []
            for p, (now, _) in enumerate(rows):
                for i in self.live:
                    for t, target in enumerate(self.data.targets):
                        known = values[name, self.data.names[i], self.data.names[target]][p]
                        if known is None:
                            continue
                        x = now[:, i].astype(np.float64)
                        ahead = rows[p][1][:, t].astype(np.float64)
                        own.append((lambda x=x, y=ahead, metric=metric: metric(x, y), known))
                        for shift in (1, 2):
                            other = rows[(p + shift) % len(rows)][1][:, t].astype(np.float64)
                            n = min(len(x), len(other))
                            crossed.append((lambda x=x[:n], y=other[:n], metric=metric: 0.0 * metric(x, y), 0.0))
            self.stage(f"{name} in each piece", own)
            self.stage(f"{name} between pieces", crossed)

    def forest(self) -> None:
        """Compute the permutation importance of the same forest by new predictions."""
        options, entries = self.spec.forest, [e for e in self.found["importance"] if e["target"] == "all"]
        members = [e["members"] for e in entries]
        columns = np.array(sorted(self.data.names.index(name) for group in members for name in group))
        held = choose_held_out(len(self.data.pieces), options.held_out, self.spec.seed)
        others = np.setdiff1d(np.arange(len(self.data.pieces)), held).tolist()
        train = rows_of(self.data, others, columns, options.samples, self.spec.horizon)
        tests = rows_of(self.data, held.tolist(), columns, options.tests, self.spec.horizon)
        mean, scale = train.changes.mean(axis=0), train.changes.std(axis=0)
        answers = (tests.changes - mean) / scale
        began = time.process_time()
        model = RandomForestRegressor(
            options.trees, min_samples_leaf=options.leaf, max_features=options.share, random_state=self.spec.seed
        ).fit(train.inputs, (train.changes - mean) / scale)
        self.seconds += (fitting := time.process_time() - began)
        self.rows.append(["forest, fitted", 1, 1, fitting, 0.0, 0.0])
        places = [[int(np.flatnonzero(columns == self.data.names.index(n))[0]) for n in group] for group in members]
        masks = [tests.pieces == p for p in held]
        power = np.mean([np.square(answers[m]).mean(axis=0) for m in masks], axis=0)
        plain = np.square(model.predict(tests.inputs) - answers)

        def importance(group: list[int]) -> float:
            total = np.zeros_like(plain)
            for repeat in range(options.repeats):
                rng, order = np.random.default_rng(self.spec.seed + repeat), np.arange(len(answers))
                for piece in np.unique(tests.pieces):
                    at = np.flatnonzero(tests.pieces == piece)
                    order[at] = rng.permutation(at)
                shuffled = tests.inputs.copy()
                shuffled[:, group] = tests.inputs[order][:, group]
                total += np.square(model.predict(shuffled) - answers) - plain
            return float(np.mean([total[m].mean(axis=0) / options.repeats / power for m in masks]))

        calls = [(lambda g=g: importance(g), e["increase"]) for g, e in zip(places, entries, strict=True)]
        self.stage("forest, permuted", calls)


def informed(x: np.ndarray, y: np.ndarray) -> float:
    return float(mutual_info_regression(x[:, None], y, n_neighbors=ScreeningSpec().neighbours, random_state=0)[0])


@benchmark(
    DATA,
    option("--whole", action="store_true", help="the rival makes every call (an hour or more)"),
    option("--ours", type=Path, nargs=2, help=argparse.SUPPRESS),
)
def main(bench: Bench) -> object:
    chosen = bench.options
    if chosen.ours:
        ours(*chosen.ours)
        return None
    minutes, each, share = (4.0, 5, 0.002) if chosen.quick else (60.0, 20, 0.02)
    base = chosen.data or bench.folder
    logs, out = base / f"screening_{minutes:g}min_{each}", bench.folder / "found.json"
    make_logs(logs, minutes, each, chosen.seed)
    subprocess.run([sys.executable, __file__, "--ours", str(logs), str(out)], check=True)
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024
    told = json.loads(out.read_text())
    data = build_table(read_data_set(logs), ScreeningSpec())
    rival = Rival(data, told["found"], 1.0 if chosen.whole else share)
    with threadpool_limits(1):
        for stage in (rival.matrices, rival.lags, rival.stability, rival.forest):
            stage()
    print(f"\n{len(data.names)} channels, {data.samples} rows, {len(data.pieces)} pieces")
    table(["stage, ours", "wall s"], [[k, v] for k, v in told["found"]["seconds"].items()])
    print()
    table(["the rival's calls", "calls", "made", "processor s, all", "median gap", "largest gap"], rival.rows)
    wall, busy = told["wall_s"], told["processor_s"]
    print(f"\nours {wall:.0f} s by the clock, {busy:.0f} s of the processors; the rival {rival.seconds:.0f} s of one")
    size = f"{len(data.names)} channels x {data.samples} rows"
    bench.check(f"whole screening of {size}", wall, SECONDS, "<= 1", "s")
    bench.check("peak memory", peak, MEGABYTES, "<= 1", "MB")
    bench.check("processor time against a plain loop", busy, rival.seconds, SHARE, "s")
    return {"stages_s": told["found"]["seconds"], "rival": rival.rows, "processor_s": busy}


if __name__ == "__main__":
    main()
