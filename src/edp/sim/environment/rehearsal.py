"""Compilation of the code of environments before the first one."""

from __future__ import annotations

import numpy as np

from edp.sim.environment.model import NominalMachine
from edp.sim.environment.spec import EnvironmentSpec
from edp.sim.environment.start import episode_start
from edp.sim.episodes.episodes import Episodes
from edp.sim.machine import layout as at
from edp.sim.physics.jit import episode_rehearsal
from edp.sim.simulate import rehearse


def rehearse_episodes() -> None:
    """Compile everything that a simulation and an environment run, once for each cache folder."""
    rehearse()
    episode_rehearsal.once(_play)


def _play() -> None:
    """Call what `edp.sim.simulate.rehearse` does not."""
    spec = EnvironmentSpec(machine="C14", material="clay", duration_s=0.1)
    episodes = Episodes(1, spec.columns)
    out = episodes.new_out()
    start = episode_start(spec, 0, None)[0]
    episodes.begin(0, start, out)
    episodes.step(np.zeros((1, at.AXES)), out)
    model = NominalMachine(start.machine)
    model.strokes(model.tip(np.ones(at.AXES)))
    model.commands(np.zeros(at.AXES))
