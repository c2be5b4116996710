"""Does an exported network drift over a day? 8.64 million ticks of C here against PyTorch in double precision.

The C program runs through the whole day on its own. PyTorch runs through it in lanes side by side: each begins a piece
early, from reset, and runs a piece into the next lane, where both must agree, since the network forgets. Weights are as
drawn, inputs are smooth random ones with a wave of a day. Errors are in standard deviations of the targets.
"""

from __future__ import annotations

import copy
import subprocess
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.signal import lfilter

from common import Bench, benchmark, option, table
from edp.data.features import FG2
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.export.c.target import CTarget
from edp.export.golden import SHARE
from edp.ir.w8a16 import calibrate
from edp.networks import ModelSpec, build_model
from edp.networks.backbones import HybridSpec
from edp.networks.blocks import TemporalDifference
from edp.networks.heads import MlpHead
from edp.networks.input_range import usual_range
from edp.networks.integer import IntegerPredictor
from edp.networks.predictor import Predictor
from edp.networks.streaming import reset_where
from edp.signals import TABLE_A1, Kind
from edp.training.bundle import Bundle

PROGRAMS = ("gcc",)

PIECE = 1_000
DAY = 8_640
"""Pieces of a day at 100 Hz."""
SPAN = 100
"""Ticks of the piece before that a piece still feels."""
Rows = NDArray[np.floating]


class Signal:
    """Smooth random inputs of a day, of which any piece can be made by itself.

    Args:
        predictor: whose inputs they are, in the usual range of each channel.
        seed: of the noise.
        pieces: of the wave.
    """

    def __init__(self, predictor: Predictor, seed: int, pieces: int) -> None:
        self.centre, self.spread = usual_range(predictor)
        self.seed, self.ticks = seed, pieces * PIECE

    def _noise(self, piece: int) -> NDArray[np.float32]:
        shape = (PIECE, len(self.centre))
        return np.random.default_rng([self.seed, piece + 1]).standard_normal(shape, dtype=np.float32)

    def piece(self, number: int) -> NDArray[np.float32]:
        """Return the inputs of a segment in SI units, shape ``(PIECE, input)``."""
        noise = np.concatenate([self._noise(number - 1)[-SPAN:], self._noise(number)])
        smooth = lfilter(np.float32([0.4]), np.float32([1.0, -0.9]), noise, axis=0)[SPAN:]
        phase = 2 * np.pi * (number * PIECE + np.arange(PIECE)) / self.ticks
        smooth += np.sin(phase[:, None] + np.arange(len(self.centre))).astype(np.float32)
        return np.asarray(self.centre + self.spread * smooth, dtype=np.float32)


@dataclass(frozen=True)
class Drift:
    """What a format loses over the day, in standard deviations of the targets.

    Attributes:
        first: root mean square error of the first 5 % of the pieces.
        last: of the last 5 %.
        worst: largest error.
        largest: largest prediction.
        seam: largest difference where two lanes overlap.
    """

    first: float
    last: float
    worst: float
    largest: float
    seam: float


def whole(bundle: Bundle, signal: Signal) -> Bundle:
    """Quantise the network, calibrated on segments of the day."""
    count = signal.ticks // PIECE
    rows = [signal.piece(number) for number in range(0, count, max(1, count // 32))]
    predictor = bundle.predictor
    return replace(bundle, predictor=IntegerPredictor(predictor, calibrate(predictor.graph(), rows)))


FORMATS: dict[str, Callable[[Bundle, Signal], Bundle]] = {"float32": lambda bundle, signal: bundle, "w8a16": whole}
"""A network in another number format."""


def program_of(bundle: Bundle, folder: Path) -> Path:
    files = CTarget().write(bundle, "predictor", folder)
    sources = [file.name for file in files if file.suffix == ".c" and file.name not in ("example_task.c", "fuzz.c")]
    command = ["gcc", "-std=c99", "-O2", "-ffp-contract=off", *sources, "-lm", "-o", "program"]
    subprocess.run(command, cwd=folder, check=True)
    return folder / "program"


def streamed(program: Path, signal: Signal, pieces: int) -> Iterator[NDArray[np.float32]]:
    """Predictions of the C program, piece by piece, from one reset."""
    with subprocess.Popen([program, "stream"], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as running:
        if running.stdin is None or running.stdout is None:
            raise RuntimeError("pipes to the program are missing")
        given, found = running.stdin, running.stdout

        def feed() -> None:
            for number in range(pieces):
                given.write(signal.piece(number).tobytes())
            given.close()

        feeder = threading.Thread(target=feed, daemon=True)
        feeder.start()
        wanted = PIECE * 4 * width_of(program)
        for number in range(pieces):
            content = found.read(wanted)
            if len(content) < wanted:
                raise RuntimeError(f"the program ended in piece {number}")
            yield np.frombuffer(content, dtype=np.float32).reshape(PIECE, -1)
        feeder.join()


def width_of(program: Path) -> int:
    """Numbers of a row that a program writes."""
    header = (program.parent / "predictor.h").read_text().split()
    at = {name: int(header[header.index(f"PREDICTOR_{name}") + 1].rstrip("u")) for name in WIDTHS}
    return at["HORIZONS"] * at["TARGETS"] * (1 + 2 * at["INTERVALS"])


WIDTHS = ("HORIZONS", "TARGETS", "INTERVALS")


def lanes_of(predictor: Predictor, signal: Signal, pieces: int, lanes: int) -> Iterator[tuple[int, Rows]]:
    """PyTorch's predictions in double precision: numbers of pieces and ``(lane, tick, number)`` for each.

    Yields for the piece `j` of every lane, ``0 <= j <= pieces / lanes``; the last one is the first of the next lane.
    """
    exact, each = copy.deepcopy(predictor).double().eval(), pieces // lanes
    first = torch.arange(lanes) == 0
    with torch.inference_mode():
        state = None
        for j in range(-1, each + 1):
            rows = np.stack([signal.piece(max(0, lane * each + j)) for lane in range(lanes)])
            x = torch.from_numpy(rows).double()
            fresh = exact.initial_state(lanes, x)
            state = fresh if state is None else reset_where(first, fresh, state) if j == 0 else state
            found, state = exact.predict(x, state)
            if j >= 0:
                yield j, found.flatten(2).numpy()


def measure(predictor: Predictor, program: Path, signal: Signal, lanes: int) -> Drift:
    """Hold a program against PyTorch over a signal whose number of pieces is a multiple of `lanes`."""
    pieces = signal.ticks // PIECE
    each = pieces // lanes
    sigma = predictor.code.width.double().numpy().ravel()
    made = np.stack([rows[:, : len(sigma)] for rows in streamed(program, signal, pieces)])
    square, worst, largest, seam = np.zeros(pieces), 0.0, 0.0, 0.0
    starts: Rows | None = None
    for j, exact in lanes_of(predictor, signal, pieces, lanes):
        if starts is None:
            starts = exact
        if j == each:
            seam = float((np.abs(exact[:-1] - starts[1:]) / sigma).max()) if lanes > 1 else 0.0
            break
        numbers = np.arange(lanes) * each + j
        error = (made[numbers] - exact) / sigma
        square[numbers] = (error**2).mean(axis=(1, 2))
        worst, largest = max(worst, float(np.abs(error).max())), max(largest, float(np.abs(exact / sigma).max()))
    edge = max(1, pieces // 20)
    first, last = (float(np.sqrt(part.mean())) for part in (square[:edge], square[-edge:]))
    return Drift(first, last, worst, largest, seam)


def make(seed: int) -> Bundle:
    """Half as wide as the thesis's student A_u32 of k = 10, so that a day takes minutes; weights as drawn."""
    task = Task(FG2, ("CylVels_1", "CylVels_2", "CylVels_3"), (10,), TargetMode.DELTA, 100.0)
    backbone = HybridSpec(channels=(16,), kernel=5, units=16)
    spec = ModelSpec(backbone=backbone, head=MlpHead(hidden=8), blocks=(TemporalDifference(),))
    features = len(FG2.features)
    scaler = Scaler(np.zeros(features), np.ones(features), np.zeros((1, 3)), np.ones((1, 3)))
    predictor = build_model(task, spec, scaler, seed).eval()
    return Bundle(predictor, tuple(TABLE_A1[name] for name in task.inputs), (Kind.VELOCITY,) * 3, task.targets)


@benchmark(option("--format", choices=list(FORMATS), default="float32"), programs=PROGRAMS)
def main(bench: Bench) -> object:
    pieces, lanes = (64, 8) if bench.quick else (DAY, 64)
    torch.set_num_threads(1)
    bundle, name = make(bench.seed), bench.options.format
    signal = Signal(bundle.predictor, bench.seed, pieces)
    program = program_of(FORMATS[name](bundle, signal), bench.folder)
    drift = measure(bundle.predictor, program, signal, lanes)
    question = f"{name}: error of the last 5 % against the first 5 %"
    bench.check(question, drift.last, drift.first, "<= 1.1", "sigma")
    if name == "float32":
        allowed = SHARE * (1 + drift.largest)
        question = f"{name}: largest error against {SHARE:g} of sigma and of the largest value"
        bench.check(question, drift.worst, allowed, "<= 1", "sigma")
    row = (name, pieces * PIECE, drift.first, drift.last, drift.worst, drift.largest, drift.seam)
    table(["format", "ticks", "first 5 %", "last 5 %", "largest error", "largest value", "seam of lanes"], [row])
    bench.name = "long_stream" if name == "float32" else f"long_stream_{name}"
    return vars(drift)


if __name__ == "__main__":
    main()
