"""The grey box that follows the machine, for `adaptation.py`: its fit, its C code on recordings, what a tick costs."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from control_step import M7, QEMU
from edp.config.twin import load_twin_experiment
from edp.data.oil import oil_celsius
from edp.data.series import Series
from edp.export.follower import FollowerParts, write_follower
from edp.export.follower.parts import GOLDEN_TICKS
from edp.ir.rls import Adaptation, RlsCorrector
from edp.networks.twin import fit_scales
from edp.networks.twin.grey.fit_spec import GreyFitSpec
from edp.networks.twin.greybox import GreyTwin
from edp.networks.twin.tuned import TunedSpec
from edp.recording import Recording
from edp.training.bundle import Bundle
from edp.training.twin_bundle import TwinBundle, plant_bundle
from edp.workflows.adaptation.with_twin import correction_of
from edp.workflows.twin.prepare_twin import prepared_twin
from embedded_step import run
from twin import fitted_linkage

BOARD = Path(__file__).parents[1] / "tests/export/board"
FLAGS = ("-std=gnu99", "-O2", "-ffp-contract=off", "-I.")
WAYS = ("follower", "follower, adapted", "follower with thermometer", "follower with thermometer, adapted")
COLD_C = 20.0
"""Of the oil in the logs of the grey box."""
Rows = NDArray[np.float64]


def fitted_grey(recordings: Sequence[Recording], fit: GreyFitSpec, seed: int) -> tuple[GreyTwin, float]:
    """A grey box of the machine before its change, told the linkage and wrong bodies; processor s of its fit."""
    channels, data = prepared_twin(list(recordings), load_twin_experiment(None, ("twin.kind=greybox",)))
    return fitted_linkage((channels, fit_scales(channels, data.train), data), seed, fit)


@dataclass(frozen=True, eq=False)
class Follower:
    """The C code of a follower, compiled.

    Attributes:
        parts: what it is made of.
        folder: of the program.
    """

    parts: FollowerParts
    folder: Path

    @staticmethod
    def built(twin: GreyTwin, bundle: Bundle, law: Adaptation, folder: Path) -> Follower:
        """Write and compile it; its self-test must pass."""
        spec = TunedSpec(oil_c=COLD_C)
        limit = correction_of(twin, law, bundle.task, spec).limit
        parts = FollowerParts("a grey box", twin, spec, bundle.task.targets, law.horizons, limit)
        write_follower(parts, plant_bundle(TwinBundle(twin.spec, twin)), "follower", folder)
        made = Follower(parts, folder)
        run(["gcc", *FLAGS, *made.sources, "host_test.c", "-lm", "-o", "program"], folder)
        print(run(["./program"], folder).strip())
        return made

    @property
    def sources(self) -> list[str]:
        listed = re.search(r"STATIC (.*)\)", (self.folder / "CMakeLists.txt").read_text())
        if listed is None:
            raise RuntimeError("the CMake file of an exported follower has another form")
        return listed[1].split()

    def moved(self, recording: Recording, base: Rows, measured_oil: bool) -> tuple[Rows, Rows]:
        """Predictions of one horizon, moved ``(time, target)``, and factors of the groups at the end."""
        part = self.parts.twin.channels.task().series(recording)
        oil = oil_celsius(recording) if measured_oil else np.full(part.samples, np.nan)
        rows = np.concatenate([part.inputs, part.targets, oil[:, None], base], axis=1).astype(np.float32)
        done = subprocess.run(
            [self.folder / "program", "stream", "1000"], input=rows.tobytes(), check=True, capture_output=True
        )
        numbers = np.frombuffer(done.stdout, np.float32).reshape(part.samples, -1).astype(float)
        targets = base.shape[1]
        return numbers[:, :targets], numbers[-1, targets + len(self.parts.twin.channels.velocities) : -1]

    def ways(self, recording: Recording, series: Series, base: Rows, law: Adaptation, warm: int) -> dict[str, Any]:
        """Predictions of each of `WAYS`, and the factors that were found."""
        found: dict[str, Any] = {}
        for way, measured in (("follower", False), ("follower with thermometer", True)):
            found[way], factors = self.moved(recording, base, measured)
            found[f"{way}, adapted"] = linear(law, series, found[way], warm)
            found[f"factors, {way}"] = factors
        return found

    def cost(self) -> dict[str, int]:
        """Instructions of a tick on a Cortex-M7 with one run of a stretch a tick, and bytes."""
        skipped = self.parts.twin.prefix_ticks + 2 * self.parts.spec.learn_ticks
        rest = [*self.sources, str(BOARD / "follow.c"), str(BOARD / "startup.c"), "-lm", "-lrdimon", "-o", "image.elf"]
        given = [
            *FLAGS,
            *M7,
            "-DCLOCK_HZ=25000000u",
            "-DRUNS=1u",
            f"-DSKIPPED={skipped}u",
            "-T",
            str(BOARD / "mps2.ld"),
        ]
        run(["arm-none-eabi-gcc", *given, *rest], self.folder)
        mean, most, *_ = run([*QEMU, "-icount", "shift=0", "-kernel", "image.elf"], self.folder).split()
        objects = [f"{Path(name).stem}_m7.o" for name in self.sources]
        for source, made in zip(self.sources, objects, strict=True):
            run(["arm-none-eabi-gcc", *FLAGS, *M7[:4], "-c", source, "-o", made], self.folder)
        lines = run(["arm-none-eabi-size", *objects], self.folder).splitlines()[1:]
        (self.folder / "state.c").write_text('#include "follower.h"\nchar state[sizeof(follower_state)];\n')
        run(["arm-none-eabi-gcc", *FLAGS, *M7[:4], "-c", "state.c", "-o", "state_m7.o"], self.folder)
        state = run(["arm-none-eabi-size", "state_m7.o"], self.folder).splitlines()[1].split()[2]
        flash = sum(int(line.split()[0]) + int(line.split()[1]) for line in lines)
        return {
            "instructions": int(mean), "most_instructions": int(most), "flash_bytes": flash, "state_bytes": int(state),
            "golden_ticks": GOLDEN_TICKS,
        }  # fmt: skip


def linear(law: Adaptation, series: Series, base: Rows, warm: int) -> Rows:
    """Predictions ``(time, target)`` behind the linear correction, which learns from what the follower leaves."""
    adapter, made = RlsCorrector(law), np.empty_like(base)
    for tick, (x, y) in enumerate(zip(series.inputs, base.astype(np.float32), strict=True)):
        made[tick] = adapter.step(x, y[None], fresh=tick + 1 >= warm)[0][0]
    return made
