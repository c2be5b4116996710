"""What does a tick of an exported twin cost beside the look-ahead predictor of the same size? Instructions, exactly.

The default twin with the channels of machine M22 (12 commands, 3 velocities, 3 strokes, 8 pressures) against a GRU that
is as wide, reads the same 26 channels and predicts the velocities. Weights as drawn: costs do not depend on them.
Both are exported to C, compiled as their CMake file says, and run under Callgrind, which counts the same at every run:
what 200 ticks more take, by 200. The twin runs free.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from board import callgrind, run, sources_of
from common import Bench, benchmark, table
from edp.data.features import FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.data.twin_channels import TwinChannels
from edp.export.c.target import CTarget
from edp.export.golden import random_inputs
from edp.networks import ModelSpec, build_model
from edp.networks.backbones import GruSpec
from edp.networks.heads import MlpHead
from edp.networks.twin import TwinScales
from edp.networks.twin.recurrent import Recurrent
from edp.signals import Channel, Kind
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle, plant_bundle

PROGRAMS = ("gcc", "valgrind")

RATE_HZ, UNITS = 100.0, 96
FLAGS = ("-std=c99", "-O2", "-ffp-contract=off", "-fno-tree-loop-vectorize")
WARM, COUNTED = 50, 200
PROGRAM = """
#include "predictor.h"
#include <stdio.h>
#include <stdlib.h>
static predictor_state state;
static predictor_output out;
int main(int argc, char **argv) {
    static float in[TICKS][PREDICTOR_INPUTS];
    const long ticks = atol(argv[1]);
    FILE *const file = fopen("rows", "rb");
    if (argc != 2 || file == NULL || fread(in, sizeof in, 1u, file) != 1u) {
        return 2;
    }
    predictor_reset(&state);
    for (long tick = 0; tick < ticks; tick++) {
        (void)predictor_step(&state, in[tick], &out);
    }
    return 0;
}
"""


@benchmark(programs=PROGRAMS)
def main(bench: Bench) -> object:
    channels = m22_channels()
    rows, found = [], {}
    for name, bundle in {"twin": twin(channels, bench.seed), "predictor": rival(channels, bench.seed)}.items():
        graph = bundle.predictor.graph()
        found[name] = {
            "instructions": instructions(bundle, bench.seed),
            "macs": graph.macs,
            "parameters": graph.parameters,
        }
        rows.append((name, *found[name].values(), found[name]["instructions"] / graph.macs))
    table(["", "instructions a tick", "MACs", "parameters", "instructions by MAC"], rows)
    ours, theirs = (float(found[name]["instructions"]) for name in ("twin", "predictor"))
    name = "time step of the exported twin against a predictor of the same size"
    bench.check(name, ours, theirs, "<= 1.3", "instructions")
    return found


def m22_channels() -> TwinChannels:
    """As many of each kind as the simulated M22 has."""

    def of(kind: Kind, name: str, count: int) -> tuple[Channel, ...]:
        return tuple(Channel(f"{name}_{i + 1}", kind) for i in range(count))

    commands = of(Kind.PILOT_PRESSURE, "pilot", 12)
    ends = (of(Kind.VELOCITY, "speed", 3), of(Kind.POSITION, "stroke", 3), of(Kind.PRESSURE, "pressure", 8))
    return TwinChannels(commands, *ends, RATE_HZ)


def twin(channels: TwinChannels, seed: int) -> Bundle:
    one = {name: np.ones(shape, np.float32) for name, shape in TwinScales.shapes(channels).items()}
    offsets = {name: 0.0 * one[name] for name in ("command_offset", "answer_offset")}
    scales = TwinScales.from_arrays(one | offsets | {"low": -10.0 * one["low"], "high": 10.0 * one["high"]})
    spec = Recurrent(units=UNITS)
    return plant_bundle(TwinBundle(spec, spec.start(channels, scales, [], seed)))


def rival(channels: TwinChannels, seed: int) -> Bundle:
    """Create a k-step-ahead GRU predictor of the velocities with as many multiplications as the twin."""
    read = channels.commands + channels.answers
    features = FeatureSet("all", tuple(channel.name for channel in read))
    targets = tuple(channel.name for channel in channels.velocities)
    task = Task(features, targets, (10,), TargetMode.DELTA, RATE_HZ)
    blank = np.zeros((1, len(targets)))
    scaler = Scaler(np.zeros(len(read)), np.ones(len(read)), blank, blank + 1.0)
    predictor = build_model(task, ModelSpec(backbone=GruSpec(units=UNITS), head=MlpHead(hidden=4)), scaler, seed).eval()
    return Bundle(predictor, read, (Kind.VELOCITY,) * len(targets), targets)


def instructions(bundle: Bundle, seed: int) -> int:
    """Of a tick, once the memory is full."""
    ticks = WARM + COUNTED
    inputs = random_inputs(bundle.predictor, ticks, seed, mixed=False)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        CTarget().write(bundle, "predictor", folder)
        (folder / "program.c").write_text(PROGRAM)
        (folder / "rows").write_bytes(inputs.tobytes())
        run(["gcc", *FLAGS, f"-DTICKS={ticks}", "program.c", *sources_of(folder), "-lm", "-o", "program"], folder)
        counts = [callgrind(folder, str(count)) for count in (WARM, ticks)]
    return (counts[1] - counts[0]) // COUNTED


if __name__ == "__main__":
    main()
