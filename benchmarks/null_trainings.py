"""How often is a module confirmed that does nothing, when the scores come from real trainings?

25 short sessions of a speed that follows a lever, each with a gain, a lag and noise of its own. For every training set
of the designs the same small network is trained with many seeds, by the function that a search calls. A study draws
from these, for each run, one training for the baseline and one for each of 14 modules: equal networks, so the null is
exact. Studies share trainings, so the standard errors are of this pool, not of all pools. The designs and rules are
those of `null_calibration.py`, which has worlds with drawn scores and independent studies.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from common import finish, parser, verdict
from edp.config.experiment import load_experiment
from edp.logs import write_recording
from edp.logs.source import DataSource
from edp.recording import Recording
from edp.signals import Channel, Kind
from edp.workflows.search.trainings import TrainingRequest, settings_of, train_order
from null_calibration import ALPHA, SOUND, THESIS, Way, null_table, sound_studies, thesis_studies
from score_worlds import METRICS, Array, Mask

SETTINGS = (
    'task={targets=["speed"], horizons=[5], features="all"}',
    'model={backbone={kind="lstm", units=4}, window=8, head={hidden=4}, blocks=[]}',
    "training.chunks={length=32, batch=4, burn_in=8}",
    'training.optimizer={kind="adamw", learning_rate=1e-2, weight_decay=1e-4}',
)
LENGTH = 400


@dataclass
class TrainedWorld:
    """Scores of real trainings; see `score_worlds.Source`.

    Attributes:
        source: the recordings.
        names: of the sessions.
        seeds: trainings of each training set, from which studies draw.
        updates: of each training.
    """

    source: DataSource
    names: tuple[str, ...]
    seeds: int
    updates: int
    name: str = "real trainings"
    modules: int = 14
    designs: int = 1
    trained: int = 0
    _pool: dict[bytes, Array] = field(default_factory=dict)

    @property
    def sessions(self) -> int:
        """Development sessions."""
        return len(self.names)

    def scores(self, tested: Mask, splits: NDArray[np.int64], effects: Array, repetition: int) -> Array:
        """See `score_worlds.Source`; effects are not for networks that are really trained."""
        if effects.any():
            raise ValueError("real trainings have the effects that they have")
        rng = np.random.default_rng([repetition, 7])
        found = np.zeros((len(METRICS), 1 + self.modules, *tested.shape))
        for split in np.unique(splits):
            runs = np.flatnonzero(splits == split)
            pool = self._of(tested[runs[0]])
            drawn = rng.permutation(self.seeds)[: len(runs) * (1 + self.modules)].reshape(len(runs), -1)
            found[:, :, runs, :] = pool[drawn].transpose(2, 1, 0, 3)
        return found

    def _of(self, tested: Mask) -> Array:
        """All trainings of a training set, ``(seed, metric, session)``."""
        key = tested.tobytes()
        if key not in self._pool:
            names = np.array(self.names)
            orders = [
                TrainingRequest(
                    settings_of(load_experiment(None, "quick", SETTINGS)),
                    self.source.to_plain(),
                    tuple(names[~tested].tolist()),
                    tuple(names[tested].tolist()),
                    seed,
                    self.updates,
                )
                for seed in range(self.seeds)
            ]
            self._pool[key] = np.stack([self._train(order, tested) for order in orders])
        return self._pool[key]

    def _train(self, order: TrainingRequest, tested: Mask) -> Array:
        sessions = train_order(order.to_json())["sessions"]
        self.trained += 1
        scores = np.zeros((len(METRICS), self.sessions))
        for place in np.flatnonzero(tested):
            scores[:, place] = [sessions[self.names[place]]["5"][metric] for metric in METRICS]
        return scores


def write_sessions(folder: Path, count: int, seed: int) -> tuple[str, ...]:
    """Recordings of a speed that follows a lever; no two sessions are quite alike."""
    names = tuple(f"session_{number:02d}" for number in range(count))
    for number, name in enumerate(names):
        rng = np.random.default_rng([seed, number])
        lever = np.repeat(rng.normal(size=LENGTH // 20), 20)
        gain, pole = rng.uniform(0.02, 0.06), rng.uniform(0.85, 0.95)
        speed = np.zeros(LENGTH)
        for t in range(1, LENGTH):
            speed[t] = pole * speed[t - 1] + gain * lever[t - 1]
        values = np.column_stack([lever, speed + 0.01 * rng.normal(size=LENGTH)]).astype(np.float32)
        channels = (Channel("lever", Kind.GENERIC), Channel("speed", Kind.VELOCITY))
        write_recording(Recording(name, channels, values, 100.0), folder / f"{name}.parquet")
    return names


def main() -> None:
    """Print the rates and the verdict."""
    arguments = parser(__doc__ or "").parse_args()
    torch.set_num_threads(1)
    seeds, updates, studies = (15, 2, 40) if arguments.quick else (48, 25, 400)
    ways: tuple[Way, ...] = (sound_studies,) if arguments.quick else (thesis_studies, sound_studies)
    with tempfile.TemporaryDirectory() as temporary:
        names = write_sessions(Path(temporary), 10 if arguments.quick else 25, arguments.seed)
        world = TrainedWorld(DataSource.of(temporary), names, seeds, updates)
        found = null_table([world], studies, arguments.seed, ways)[world.name]
    print(f"\n{world.trained} trainings; any false module: sound {found[SOUND].any_false:.3f}", end="")
    print(f", thesis {found[THESIS].any_false:.3f}" if THESIS in found else "")
    share, details = found[SOUND].any_false, {name: vars(one) for name, one in found.items()}
    verdicts = [verdict("any false module of 14, real trainings", share, ALPHA, "<= 1", "share", arguments.quick)]
    finish("null_trainings", verdicts, arguments.seed, {"trainings": world.trained, "rates": details})


if __name__ == "__main__":
    main()
