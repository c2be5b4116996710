"""Learn to grade by reinforcement on a twin (or the simulator), then judge the policy on the simulator beside PI.

    pip install 'excavator-dynamics-predictor[rl]'
    edp simulate data --machine M22 --minutes 40 && edp twin data --out runs/twin --set twin.kind=greybox
    python examples/reinforcement_learning/learn_grading.py --plant runs/twin --out runs/policy

The policy corrects the levers of PI twenty times a second. References of the training are never those of the judgement.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from edp.control.controllers.pi import ProportionalIntegral
from edp.control.learning import LearningSpec, PolicyController, VectorTaskEnvironment
from edp.control.loop import run_loop
from edp.control.models import ControlModels
from edp.control.plant import interface_of
from edp.control.plants import plant_of
from edp.control.tasks import draw_task
from edp.control.valve_map import measure_valve_map
from edp.errors import ConfigError, EdpError

try:
    import torch
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecEnv
except ImportError:
    sys.exit("this example needs Stable-Baselines3: pip install 'excavator-dynamics-predictor[rl]'")

SPEC = LearningSpec(task="grade", base="pi", hold=5, duration_s=15.0)
VALIDATION_SEED = 900_000
"""First of the references that compare settings of the training; those of the judgement count from 0."""


class SideBySide(VecEnv):
    """Lanes of a `VectorTaskEnvironment` as Stable-Baselines3 wants them."""

    def __init__(self, spec: LearningSpec, lanes: int, seed: int) -> None:
        self.lanes = VectorTaskEnvironment(lanes, spec, autoreset_mode="SameStep")
        super().__init__(lanes, self.lanes.single_observation_space, self.lanes.single_action_space)
        # Seeds of references: far from each other for each seed of a training.
        self.first = [spec.seeds[0] + 10_000 * seed + lane for lane in range(lanes)]
        self.scores: list[float] = []
        self._actions = np.zeros((lanes, 3), np.float32)

    def reset(self) -> np.ndarray:
        first, self.first = self.first, [None] * self.num_envs
        return self.lanes.reset(seed=first)[0]

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = actions

    def step_wait(self) -> Any:
        observations, rewards, lost, truncated, infos = self.lanes.step(self._actions)
        each: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for lane in np.flatnonzero(lost | truncated).tolist():
            each[lane]["terminal_observation"] = infos["final_obs"][lane]
            each[lane]["TimeLimit.truncated"] = bool(truncated[lane])
            self.scores.append(float(infos["final_info"]["score"]["position_rms_mm"][lane]))
        return observations, rewards.astype(np.float32), lost | truncated, each

    def close(self) -> None:
        self.lanes.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.lanes, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise NotImplementedError("lanes share one environment; make a new one with another setting")

    def env_method(self, method_name: str, *arguments: Any, indices: Any = None, **named: Any) -> list[Any]:
        raise NotImplementedError("lanes share one environment, which has no methods for one of them")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * self.num_envs


def learn(spec: LearningSpec, steps: int, lanes: int, seed: int) -> PPO:
    """A policy after `steps` actions, all lanes together."""
    envs = SideBySide(spec, lanes, seed)
    model = PPO(
        "MlpPolicy",
        envs,
        n_steps=128,
        # An eighth of what is collected.
        batch_size=16 * lanes,
        n_epochs=5,
        learning_rate=lambda share: 1e-4 + 4e-4 * share,
        # 0.97 at 20 actions a second looks 1.6 s ahead: the machine answers within 0.3 s.
        gamma=0.97,
        gae_lambda=0.9,
        clip_range=0.2,
        # Corrections of 0.2 in levers at most: exploration begins at a sixth of that, and at PI itself.
        policy_kwargs={"net_arch": [64, 64], "log_std_init": -1.8},
        seed=seed,
        device="cpu",
    )
    began = time.process_time()

    def tell(local: dict[str, Any], _: dict[str, Any]) -> bool:
        if len(envs.scores) >= 100:
            seconds = time.process_time() - began
            print(f"{model.num_timesteps:>9,} actions, {seconds:5.0f} s: {np.mean(envs.scores):6.1f} mm", flush=True)
            envs.scores.clear()
        return True

    model.learn(steps, callback=tell)
    envs.close()
    return model


def judge(model: PPO, spec: LearningSpec, seeds: Sequence[int], plant: Path | None = None) -> dict[str, Any]:
    """Scores of the policy and of PI along the same references, on the simulator or another plant."""
    env = plant_of(spec.machine, spec.duration_s + 30.0, spec.rate_hz, plant)
    interface = interface_of(env)
    models = ControlModels(valve_map=measure_valve_map(env, interface))
    scores: dict[str, list[Any]] = {"policy": [], "pi": []}
    for seed in seeds:
        task = draw_task(spec.task_spec, interface.geometry, spec.rate_hz, seed)
        contenders = {
            "policy": PolicyController(
                lambda seen: model.predict(seen, deterministic=True)[0], spec, interface, task.limits, models
            ),
            "pi": ProportionalIntegral().build(interface, task.limits, models),
        }
        for name, controller in contenders.items():
            scores[name].append(run_loop(env, controller, task, seed).score)
    return {
        name: {
            "position_rms_mm": float(np.mean([score.position_rms_mm for score in listed])),
            "worst_mm": max(score.position_rms_mm for score in listed),
            "path_rms_mm": float(np.mean([score.path_rms_mm for score in listed])),
            "attitude_rms_deg": float(np.mean([score.attitude_rms_deg for score in listed])),
            "lever_travel": float(np.mean([score.lever_travel for score in listed])),
            "violations": sum(sum(score.violations.values()) for score in listed),
            "missed": sum(score.missed for score in listed),
            "each_mm": [score.position_rms_mm for score in listed],
        }
        for name, listed in scores.items()
    }


def show(where: str, figures: dict[str, Any]) -> None:
    for name, values in figures.items():
        print(
            f"{where}: {name:<6} position {values['position_rms_mm']:5.1f} mm (worst {values['worst_mm']:5.1f}), "
            f"path {values['path_rms_mm']:5.1f} mm, attitude {values['attitude_rms_deg']:.2f} deg, lever travel "
            f"{values['lever_travel']:.1f}, limits violated {values['violations']}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--plant", type=Path, help="run folder of a twin to learn on; left out: the simulator")
    parser.add_argument("--out", type=Path, default=Path("runs/policy"), help="folder of policy.zip and results.json")
    parser.add_argument("--steps", type=int, default=1_000_000, help="actions, all lanes together")
    parser.add_argument("--lanes", type=int, default=32, help="machines side by side")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--loops", type=int, default=12, help="references that judge, from seed 0 on")
    parser.add_argument("--validation", action="store_true", help="judge on references for comparing settings instead")
    given = parser.parse_args()
    if min(given.steps, given.lanes, given.loops) < 1:
        raise ConfigError("--steps, --lanes and --loops must be at least 1")
    torch.set_num_threads(1)
    spec = replace(SPEC, plant=given.plant)
    given.out.mkdir(parents=True, exist_ok=True)
    model = learn(spec, given.steps, given.lanes, given.seed)
    model.save(given.out / "policy.zip")
    first = VALIDATION_SEED if given.validation else 0
    seeds = range(first, first + given.loops)
    results = {"simulator": judge(model, spec, seeds)}
    if given.plant is not None:
        results["plant of the learning"] = judge(model, spec, seeds, given.plant)
    for where, figures in results.items():
        show(where, figures)
    (given.out / "results.json").write_text(json.dumps(results, indent=1))


if __name__ == "__main__":
    try:
        main()
    except EdpError as error:
        sys.exit(str(error))
