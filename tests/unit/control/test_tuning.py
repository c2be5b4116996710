"""Gains that are better on a model: correlation and regret by hand-made costs, drawn settings, the bench."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.models import ControlModels
from edp.control.tasks import TASKS
from edp.control.valve_map import ValveMap
from edp.errors import ConfigError
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.workflows.control import ControlBench, ControlSources, TuningSpec, tune_gains
from edp.workflows.control.transfer_of_tuning import TransferSpec, TuningTransfer, costs_of, draw_settings
from edp.workflows.control.tune_gains import TUNING_SEED


@pytest.fixture(scope="module")
def bench():
    task = TASKS["grade"](length_m=(0.4, 0.5), hold_s=0.2)
    experiment = ControlExperiment(task=task, controller=CONTROLLERS["pi"](), loops=1)
    return ControlBench(experiment, ControlSources(), ControlModels(ValveMap(*speed_table(load_machine("M22")))))


def test_correlation_and_regret_are_those_of_the_ranks():
    plant = np.array([10.0, 20.0, 40.0, 80.0])
    assert TuningTransfer(plant**2, plant).rank_correlation == pytest.approx(1.0)
    assert TuningTransfer(plant**2, plant).regret == 1.0
    assert TuningTransfer(-plant, plant).rank_correlation == pytest.approx(-1.0)
    assert TuningTransfer(-plant, plant).regret == 8.0
    # Ranks 1, 2, 4, 3 against 1, 2, 3, 4: 1 - 6 * 2 / (4 * 15).
    assert TuningTransfer(np.array([1.0, 2.0, 4.0, 3.0]), plant).rank_correlation == pytest.approx(0.8)
    assert TuningTransfer(np.ones(4), plant).rank_correlation == 0.0


def test_settings_are_drawn_from_the_space_by_their_seed():
    spec = CONTROLLERS["pi"]()
    first, again, other = (draw_settings(spec, TransferSpec(20, seed)) for seed in (1, 1, 2))
    assert first == again != other
    for name, (low, high) in spec.space.items():
        values = [getattr(setting, name) for setting in first]
        assert low <= min(values) < 0.5 * (low + high) < max(values) <= high


def test_a_bench_gives_equal_gains_equal_costs_and_worse_ones_higher(bench):
    good = CONTROLLERS["pi"]()
    slack = replace(good, proportional=0.0, integral=0.0, lead_s=0.0, standstill_m_s=1.0)
    costs = costs_of(bench, [good, slack, good])
    assert costs[0] == costs[2] < costs[1]


def test_options_of_a_reset_reach_the_plant(bench):
    warm = ControlBench(bench.experiment, ControlSources(), bench.models, {"oil_temperature": 65.0})
    (result,) = warm.results()
    assert result.recording.column("OilTemperature_true")[0] == pytest.approx(273.15 + 65.0, abs=0.1)


def test_seeds_of_the_judgement_never_reach_those_of_the_tuning(tmp_path):
    experiment = ControlExperiment(seed=TUNING_SEED)
    with pytest.raises(ConfigError, match="references from 1000000 on are for tuning"):
        tune_gains(experiment, tmp_path / "run", ControlSources(), ControlSources(), TuningSpec(trials=1, loops=1))


@pytest.mark.long
def test_a_stopped_tuning_continues_after_its_last_trial_and_a_finished_one_is_read(tmp_path, monkeypatch):
    made = []

    def run(bench, number, spec, guard=None):
        if bench.experiment.seed == TUNING_SEED:
            if len(made) == stop_at:
                raise KeyboardInterrupt
            made.append(spec)
        return SimpleNamespace(score=SimpleNamespace(position_rms_mm=abs(spec.proportional - 3.0)))

    monkeypatch.setattr(ControlBench, "check", lambda bench: None)
    monkeypatch.setattr(ControlBench, "run", run)
    experiment = ControlExperiment(task=TASKS["grade"](), controller=CONTROLLERS["pi"](), loops=2)

    def tune(folder):
        spec = TuningSpec(trials=5, loops=1, sampler="random")
        return tune_gains(experiment, tmp_path / folder, ControlSources(), ControlSources(), spec)

    stop_at = -1
    whole, trials = tune("whole"), list(made)
    for stop_at in range(1, 5):
        made.clear()
        with pytest.raises(KeyboardInterrupt):
            tune(f"stopped_{stop_at}")
        folder, stop_at = f"stopped_{stop_at}", -1
        assert tune(folder).content == whole.content
        assert made == trials
        assert not (tmp_path / folder / "units").exists()
    made.clear()
    assert tune("whole").content == whole.content
    assert tune("whole").best == whole.best
    assert made == []
