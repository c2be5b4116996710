"""The example of reinforcement learning: a few hundred actions on a twin, judged on the simulator beside PI."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "stable_baselines3", reason="needs Stable-Baselines3: pip install 'excavator-dynamics-predictor[rl]'"
)
from edp.networks.twin import TWINS
from edp.testing.control import sample_excavator_twin
from edp.training.twin_bundle import TwinBundle, save_twin

FOLDER = Path(__file__).parents[2] / "examples/reinforcement_learning"


@pytest.fixture(scope="module")
def example():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(FOLDER)
        import learn_grading

        yield learn_grading
        sys.modules.pop("learn_grading", None)


def test_it_learns_on_a_twin_and_is_judged_on_the_simulator(example, tmp_path, monkeypatch, capsys):
    save_twin(TwinBundle(TWINS["static"](), sample_excavator_twin()), tmp_path / "run" / "twin")
    words = ["--plant", tmp_path / "run", "--out", tmp_path / "out", "--steps", 256, "--lanes", 2, "--loops", 1]
    monkeypatch.setattr(sys, "argv", ["learn_grading.py", *map(str, words)])
    example.main()
    results = json.loads((tmp_path / "out" / "results.json").read_text())
    assert set(results) == {"simulator", "plant of the learning"}
    for figures in results.values():
        assert figures["pi"]["missed"] == figures["policy"]["missed"] == 0
        # It begins at PI, and so few actions do not lead far away.
        assert figures["policy"]["position_rms_mm"] == pytest.approx(figures["pi"]["position_rms_mm"], rel=0.2)
    assert (tmp_path / "out" / "policy.zip").is_file()
    assert "policy position" in capsys.readouterr().out


def test_the_lanes_of_the_library_are_those_of_the_environment(example):
    spec = example.replace(example.SPEC, duration_s=1.0, base="", hold=10)
    envs = example.SideBySide(spec, 2, seed=1)
    first = envs.reset()
    for _ in range(12):
        rows, rewards, ended, infos = envs.step(np.zeros((2, 3), np.float32))
        if ended.any():
            break
    assert ended.all()
    assert rewards.shape == (2,)
    assert infos[0]["TimeLimit.truncated"]
    assert infos[0]["terminal_observation"].shape == first[0].shape
    assert len(envs.scores) == 2
    assert not np.array_equal(rows, [info["terminal_observation"] for info in infos])
    with pytest.raises(NotImplementedError):
        envs.env_method("reset")
