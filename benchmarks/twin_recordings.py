"""Is the default twin at least as good as simple plant models, on free runs along measured recordings?

Each set is a machine with one or two actuators: commands, and positions whose change from tick to tick is the
velocity. The first 55 % of every recording train, then 20 % choose and calibrate, the last 25 % are judged: free runs
of 30 s, or as long as the recordings allow. The twin is what `edp twin` gives without settings; the rivals are the
static map, ARX and a subspace model, fitted in the same run to training and validation part together. The error is the
geometric mean over actuators, of velocities and of strokes at each time, over that of the static map.

    python benchmarks/twin_recordings.py --logs LOGS --map MAP.toml --repair gaps=cut --repair nan=hold

judges a folder of one's own logs in the same way, by whole recordings.

The recordings are no part of the repository: their folder is given by --shared or EDP_SHARED_DATA.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from common import EXAMPLES, VARIABLE, Bench, benchmark, option, shared_folder, table, verdict
from edp.cli.options import source_of
from edp.config.twin import TwinExperiment, load_twin_experiment
from edp.data.prepared import Prepared
from edp.data.splits import ByRecording, ByTime
from edp.data.twin_channels import TwinChannels, TwinChannelSettings
from edp.evaluation.free_run import free_run_scores, free_runs
from edp.evaluation.guard import free_run_error
from edp.logs.source import DataSource
from edp.networks.twin import TWINS, fit_scales
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.storage.runs import KeyedRun, Run
from edp.workflows.twin.choose_twin import TwinChoice
from edp.workflows.twin.fit_twin import TwinFit
from edp.workflows.twin.prepare_twin import cut_recordings
from verdicts import Verdict

RIVALS = ("static", "arx", "n4sid")
SPLIT = ByTime(validation_fraction=0.2, test_fraction=0.25)
QUICK = ("training.updates=[60,60,60,20]", "training.batch=16")
QUICK_SETS = ("sjoberg", "cylinders")


@dataclass(frozen=True)
class MachineSet:
    """How a set becomes a machine.

    Attributes:
        commands: columns that command.
        positions: columns of what moves, linear or turning.
        turning: whether the positions are angles.
        pressures: columns.
        prefix_ticks: measured ticks before a free run; the default of a twin is 30.
    """

    commands: tuple[str, ...]
    positions: tuple[str, ...]
    turning: bool = False
    pressures: tuple[str, ...] = ()
    prefix_ticks: int = 30


SETS = {
    "cylinders": MachineSet(("r0", "r1"), ("y0", "y1"), prefix_ticks=10),
    "hanging_load": MachineSet(("valve",), ("position",)),
    "motor": MachineSet(("current",), ("output",), turning=True),
    "emps": MachineSet(("u",), ("q",)),
    "sjoberg": MachineSet(("u",), ("x",), pressures=("p",), prefix_ticks=10),
    "faster": MachineSet(("u",), ("d",)),
}


def machine(recording: Recording, which: MachineSet) -> Recording:
    """Return the recording with the channels of the machine and their kinds."""
    kinds = dict.fromkeys(which.commands, Kind.RATIO)
    kinds |= dict.fromkeys(which.positions, Kind.ANGLE if which.turning else Kind.POSITION)
    kinds |= dict.fromkeys(which.pressures, Kind.PRESSURE)
    values = np.ascontiguousarray(np.stack([recording.column(name) for name in kinds], axis=1), dtype=np.float32)
    channels = tuple(Channel(name, kind) for name, kind in kinds.items())
    return Recording(recording.name, channels, values, recording.rate_hz, recording.source)


def experiment_of(seed: int, quick: bool, prefix_ticks: int = 30) -> TwinExperiment:
    experiment = load_twin_experiment(None, (f"training.seed={seed}", *(QUICK if quick else ())))
    return replace(experiment, twin=replace(experiment.twin, prefix_ticks=prefix_ticks))


def measure(channels: TwinChannels, data: Prepared, experiment: TwinExperiment) -> dict[str, Any]:
    """Errors over the static map's in the test part, of the default twin and its rivals, and what was chosen."""
    began = time.process_time()
    scales, seed = fit_scales(channels, data.train), experiment.training.seed
    judge = replace(experiment.evaluation, seconds=30.0, starts=8, at_s=(1.0, 5.0, 10.0, 30.0))
    with tempfile.TemporaryDirectory() as folder, Run(folder) as run:
        fit = TwinFit(channels, scales, data, experiment)
        result, tried = TwinChoice(fit, experiment.twin, KeyedRun(run, "0" * 32)).best()
    twins = {"twin": result.fitted.twin}
    # The twin's validation part chose; what needs no choice has it to learn from.
    everything = [*data.train, *data.validation]
    for name in RIVALS:
        spec = replace(TWINS[name](), prefix_ticks=experiment.twin.prefix_ticks)
        twins[name] = spec.start(channels, fit_scales(channels, everything), everything, seed)
    scores = {name: free_run_scores(free_runs(twin, data.test, judge.duration_s, judge.starts), judge)
              for name, twin in twins.items()}  # fmt: skip
    chosen = next(one for one in tried if one.chosen)
    return {
        "errors": {name: free_run_error(row, scores["static"]) for name, row in scores.items()},
        "diverged": {name: row.diverged for name, row in scores.items()},
        "chosen": chosen.label,
        "promise": chosen.error,
        "candidates": [one.row() for one in tried],
        "processor_s": round(time.process_time() - began, 1),
    }


def public_sets(seed: int, quick: bool) -> dict[str, dict[str, Any]]:
    """Every set of recordings that others made."""
    found = {}
    for name, which in SETS.items():
        if quick and name not in QUICK_SETS:
            continue
        recordings = [machine(recording, which) for recording in DataSource.from_path(EXAMPLES / f"{name}.toml").read()]
        experiment = replace(experiment_of(seed, quick, which.prefix_ticks), split=SPLIT)
        experiment = replace(experiment, channels=TwinChannelSettings(commands=which.commands))
        found[name] = measure(*cut_recordings(recordings, experiment), experiment)
        print(f"{name}: {found[name]['chosen']}, {found[name]['processor_s']} processor s", flush=True)
    return found


def own_logs(given: Any) -> dict[str, dict[str, Any]]:
    """Evaluate a folder of logs on complete held-out recordings."""
    recordings = source_of(given.logs, given.map, given.repair).read()
    experiment = replace(experiment_of(given.seed, given.quick), split=ByRecording(seed=given.seed))
    return {given.logs.name: measure(*cut_recordings(recordings, experiment), experiment)}


def show(found: dict[str, dict[str, Any]], quick: bool) -> list[Verdict]:
    """Print a row a set; the twin against the best of its rivals."""
    rows, verdicts = [], []
    for name, row in found.items():
        errors = row["errors"]
        best = min(RIVALS, key=lambda rival: float(errors[rival]))
        shares = [f"{errors[one]:.3f} ({row['diverged'][one]:.0%})" for one in ("twin", *RIVALS)]
        rows.append([name, row["chosen"], *shares, f"{row['promise']:.3f}", row["processor_s"]])
        verdicts.append(verdict(f"{name}: twin against {best}", errors["twin"], errors[best], "<= 1", "1"))
    print("\nerror of free runs over the static map's (share of diverged runs)" + (" (quick)" if quick else ""))
    table(["set", "chosen", "twin", *RIVALS, "promise", "processor s"], rows)
    mean = math.exp(sum(math.log(one.ratio) for one in verdicts) / len(verdicts))
    verdicts.append(verdict("geometric mean over sets, twin against the best baseline", mean, 1.0, "<= 0.9", "1"))
    return verdicts


@benchmark(
    option("--shared", dest="recordings", type=Path, help=f"folder of the recordings (else ${VARIABLE})"),
    option("--logs", type=Path, help="a folder of own logs in place of the public sets"),
    option("--map", type=Path, help="signal map of --logs"),
    option("--repair", action="append", default=[], help="as of edp twin"),
)
def main(bench: Bench) -> object:
    if bench.options.logs is None:
        shared_folder(bench.options.recordings)
        found = public_sets(bench.seed, bench.quick)
    else:
        # What somebody's own logs give is theirs, and takes no other result's place.
        found, bench.keep = own_logs(bench.options), False
    bench.verdicts += show(found, bench.quick)
    return found


if __name__ == "__main__":
    main()
