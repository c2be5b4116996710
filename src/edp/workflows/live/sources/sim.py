"""``--sim``: simulator, sample by sample, with a simulated operator."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np

from edp.control.loop import LEVERS
from edp.errors import ConfigError
from edp.signals import EXTRA_CHANNELS
from edp.sim.excitation import EXCITATIONS
from edp.sim.view import View
from edp.storage.reading import Table
from edp.workflows.live.sources.base import SOURCES, LiveSource, Needs, Sink, SourceOptions

EPISODE_S = 3600.0
"""Length of an episode; another one of the next seed follows."""
USUAL_RATE_HZ = 100.0
USUAL_EXCITATION = "combined"
COMPILING = "preparing the simulator; its first start on a computer compiles it, which takes about a minute"


@SOURCES.register("sim")
class SimSource(LiveSource):
    """Simulated machine that works without end.

    Args:
        machine: name, or path of a machine file.
        rate_hz: ticks per second.
        seed: random seed of the first episode.
        settings: ``excitation``, ``faults`` (texts, see `edp.sim.faults`) and ``material``, where they are given.
        further: names of additional simulator channels to show.

    Raises:
        EdpError: gymnasium is not installed, or there is no such machine or excitation.
    """

    options: ClassVar[frozenset[str]] = frozenset({"excitation", "fault", "seed", "rate", "speed"})
    preparing: ClassVar[str] = COMPILING

    def __init__(
        self,
        machine: str,
        rate_hz: float,
        seed: int = 0,
        settings: Table | None = None,
        further: Sequence[str] = (),
    ) -> None:
        # Gymnasium is an extra, and this brings the compiler of the simulator.
        from edp.sim.environment import EnvironmentSpec, ExcavatorEnv
        from edp.sim.environment.spec import OBSERVED

        chosen = dict(settings or {})
        name = chosen.get("excitation") or USUAL_EXCITATION
        self._kind, self._seed = EXCITATIONS[name], seed
        material = chosen.get("material") or ""
        if self._kind.works_ground and not material:
            raise ConfigError(f"--excitation {name} works the ground, of which there is none here; choose another one")
        if self._kind.swings:
            raise ConfigError(f"--excitation {name} swings and travels, which nothing here does; choose another one")
        self._env = ExcavatorEnv(
            EnvironmentSpec(
                machine=machine,
                duration_s=EPISODE_S,
                rate_hz=rate_hz,
                hand=self._kind.by_hand,
                material=material,
                faults=tuple(chosen.get("faults") or ()),
                observed=(*OBSERVED, *(name for name in further if name in EXTRA_CHANNELS and name not in OBSERVED)),
            )
        )
        self.channels, self.rate_hz, self.machine = (*self._env.channels, *LEVERS), rate_hz, machine
        self.text = f"simulator, {self._env.machine.name}, {name}, seed {seed}"

    @classmethod
    def from_options(cls, options: SourceOptions, needs: Needs) -> SimSource:
        """Return `SourceOptions.value` is the machine."""
        rate_hz = options.rate_hz or needs.rate_hz or USUAL_RATE_HZ
        names = [channel.name for channel in needs.channels]
        return cls(options.value, rate_hz, options.seed or 0, options.settings, names)

    def prepare(self) -> None:
        """Compile the simulator (see `LiveSource`); each episode begins with a reset."""
        self._env.reset(seed=self._seed)
        self._env.step(np.zeros(len(LEVERS), np.float32))

    def run(self, sink: Sink) -> None:
        """See `LiveSource`."""
        seed = self._seed
        while True:
            self._episode(sink, seed)
            seed += 1
            sink.note("note", f"a new episode begins, seed {seed}")
            sink.begin_anew()

    def _episode(self, sink: Sink, seed: int) -> None:
        env = self._env
        observation, info = env.reset(seed=seed)
        operator = self._kind(np.random.default_rng(seed), self.rate_hz, env.machine)
        full = np.array(env.machine.cylinders.stroke)
        ended = False
        while not ended:
            for levers in operator.block(view_of_truth(info["truth"], full)):
                sink.take(np.concatenate([observation, levers]))
                observation, _, _, ended, info = env.step(levers)
                if ended:
                    break


def view_of_truth(truth: Table, full: Any) -> View:
    """Return the view of an operator from the noise-free channels of an environment.

    `full` are strokes (m), shape (3,).
    """
    strokes, angles, rates, speeds = (
        np.array([truth[f"{kind}_{i}"] for i in (1, 2, 3)])
        for kind in ("CylStroke", "JointAngle", "JointVel", "CylVels")
    )
    return View(strokes / full, angles, rates, speeds, truth["TipX"], truth["TipY"], truth["TipAngle"])
