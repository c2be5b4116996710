"""A network on top of a grey box: the adjoint through both, the grey box itself where the network answers zero."""

import copy
from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from edp.config.twin import load_twin_experiment, twin_toml
from edp.data.series import Series
from edp.errors import ConfigError
from edp.evaluation.free_run import FreeRunJudgeSpec, free_run_scores, free_runs
from edp.export.golden import random_inputs, stream
from edp.networks.twin import TwinPlant, fit_scales
from edp.networks.twin.greybox import GreyBox
from edp.networks.twin.residual import Residual
from edp.testing.bench import bench_channels, bench_series
from edp.testing.twins import sample_actuators, sample_twin
from edp.training.free_run import FreeRunSpec
from edp.training.residual_fit import fit_residual
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin

from .test_grey_box import BENCH

UNITS = 6
OPTIONS = {entry.name: getattr(BENCH, entry.name) for entry in fields(BENCH)}
SPEC = Residual(**OPTIONS, units=UNITS, batch=16, lengths_s=(0.2,), updates=(60,), validate_every=20)


@pytest.fixture(scope="module")
def machine():
    """A twin of the bench with known numbers, and runs of it."""
    channels, levers = bench_channels(), [bench_series(seed=seed) for seed in range(4)]
    twin = SPEC.start(channels, fit_scales(channels, levers), levers, 0)
    numbers = twin.table.nominal
    numbers[twin.table.inertia_at], numbers[twin.table.potential_at] = 0.07, 0.01
    # Far above what acts, unlike where a fit starts: limited all the time, faults of a valve would hardly show.
    numbers[[number.name for number in twin.table.numbers].index("power_limit")] *= 10.0
    twin = twin.with_parameters(numbers)
    start = np.tile(np.array([0.0, 0.5, 5e6, 5e6, 5e6], np.float32), (len(levers), 1))
    commands = np.stack([series.inputs for series in levers])
    answers, _ = twin.rollout(commands[:, :-1], twin.initial_state(commands[:, 0], start))
    rows = np.concatenate([start[:, None], answers], axis=1)
    return twin, [Series(f"run {i}", commands[i], rows[i]) for i in range(len(levers))]


def scaled_case(twin, runs, ticks, starts):
    """Commands, measured values and truth of stretches, scaled, tick first."""
    rows = [slice(first, first + ticks + 1) for first in starts]
    commands = np.stack([twin.scale_commands(runs[0].inputs[row])[:-1] for row in rows], axis=1)
    answers = np.stack([twin.scaled(runs[0].targets[row]) for row in rows], axis=1)
    return torch.from_numpy(commands), torch.from_numpy(answers[:-1]), torch.from_numpy(answers[1:])


def drawn(twin, size):
    """The same grey box with a network whose answers are not zero."""
    again = twin.drop_network()
    generator = torch.Generator().manual_seed(1)
    for weight in again.network.parameters():
        weight.data.normal_(0, size, generator=generator)
    return again


@pytest.mark.parametrize("mixed", [False, True], ids=["free", "mixed"])
def test_gradients_are_those_of_differences(machine, mixed):
    twin, runs = machine
    twin = drawn(twin, 0.15)
    commands, measured, truth = scaled_case(twin, runs, 24, (60, 230, 410, 600))
    port = torch.zeros_like(measured)
    port[:6] = 1.0
    if mixed:
        port[6:, 2, 0] = port[14:, 3] = 1.0
    target = truth.double() + torch.linspace(-1, 1, truth.numel(), dtype=torch.float64).view(truth.shape)

    def loss():
        return (twin.free_run(commands, measured, port).double() - target).square().sum()

    loss().backward()
    generator = torch.Generator().manual_seed(2)
    for name, weight in twin.network.named_parameters():
        direction = torch.randn(weight.shape, generator=generator)
        direction /= direction.norm()
        plain, sides = weight.data.clone(), []
        for step in (5e-4, -5e-4):
            weight.data = plain + step * direction
            sides.append(loss().item())
        weight.data = plain
        along, difference = float((weight.grad * direction).sum()), (sides[0] - sides[1]) / 1e-3
        assert along == pytest.approx(difference, rel=0.01, abs=2e-3 * float(weight.grad.norm())), name


def test_bounds_act_and_pass_no_gradient(machine):
    twin, runs = machine
    twin = drawn(twin, 0.15)
    commands, measured, _ = scaled_case(twin, runs, 10, (60, 230))
    with torch.no_grad():
        twin.network.out_bias.fill_(1e6)
    answers = twin.free_run(commands, measured, torch.ones_like(measured))
    speed = answers[..., 0].detach() * twin.scales.answer_width[0]
    np.testing.assert_allclose(speed, np.full(speed.shape, twin.scales.high[0]), rtol=1e-5)
    answers.square().sum().backward()
    assert all(not weight.grad.any() for weight in twin.network.parameters())


def test_untrained_it_is_its_grey_box_to_the_bit():
    recording = sample_actuators()
    twin, commands, measured = sample_twin(Residual(units=UNITS), recording)
    grey, _, _ = sample_twin(GreyBox(), recording)
    prefix = twin.prefix_ticks
    mixed = np.where(np.random.default_rng(0).random(measured.shape) < 0.5, measured, np.nan).astype(np.float32)
    for ports in (None, mixed[:, prefix:]):
        answers = [
            each.rollout(commands[:, prefix:], each.reset(commands[:, :prefix], measured[:, :prefix]), ports)[0]
            for each in (twin, grey)
        ]
        assert np.array_equal(*answers)
    other = drawn(twin, 0.3)
    state = other.reset(commands[:, :prefix], measured[:, :prefix])
    assert not np.array_equal(other.rollout(commands[:, prefix:], state)[0], answers[1])


@pytest.mark.long
def test_a_network_learns_what_the_equations_lack_and_is_kept(machine):
    twin, runs = machine
    lame = twin.numbers.copy()
    names = [number.name for number in twin.table.numbers]
    for name in ("into_extend_45", "into_retract_45", "viscous"):
        lame[names.index(name)] *= 3.0
    start = twin.with_parameters(lame).drop_network()
    # Long enough for velocities and strokes, which choose the weights together.
    spec = replace(SPEC, updates=(200,))
    fit = fit_residual(start, spec, runs[:2], runs[2:3], FreeRunSpec(validation_s=2.0))
    assert fit.helps
    # What is fitted; how much of it is velocities differs with the rounding of the machine.
    assert fit.error < 0.8 * fit.grey_error
    judge = FreeRunJudgeSpec(at_s=(2.0,))
    with_network, alone = (
        free_run_scores(free_runs(one, runs[2:3], 2.0, 32), judge).velocity_mae.mean
        for one in (fit.twin, fit.twin.drop_network())
    )
    assert with_network < 0.9 * alone
    assert fit.error == min(row["validation"] for row in fit.history)
    np.testing.assert_array_equal(fit.twin.numbers, start.numbers)


@pytest.mark.long
def test_a_network_that_does_not_help_is_not_kept(machine):
    twin, runs = machine
    # The grey box is the machine itself, and a network that was drawn at random has two updates to unlearn.
    spec = replace(SPEC, updates=(2,), validate_every=1)
    fit = fit_residual(drawn(twin, 0.3), spec, runs[:2], runs[2:3], FreeRunSpec(validation_s=2.0))
    assert not fit.helps
    assert fit.error > fit.grey_error
    commands = np.stack([series.inputs[:-1] for series in runs])
    first = np.stack([series.targets[0] for series in runs])
    answers = [each.rollout(commands, each.initial_state(commands[:, 0], first))[0] for each in (fit.twin, twin)]
    assert np.array_equal(*answers)


def test_settings_come_back_and_what_cannot_be_is_refused(tmp_path):
    text = '[twin]\nkind = "residual"\nunits = 8\nwithout = ["play"]\nfit = { starts = 2 }\n'
    (tmp_path / "twin.toml").write_text(text)
    experiment = load_twin_experiment(tmp_path / "twin.toml")
    (tmp_path / "again.toml").write_text(twin_toml(experiment))
    assert load_twin_experiment(tmp_path / "again.toml") == experiment
    assert (experiment.twin.units, experiment.twin.fit.starts, experiment.twin.omit) == (8, 2, ("play",))
    with pytest.raises(ConfigError, match="3 lengths_s and 2 updates"):
        Residual(updates=(1, 2))


def test_it_comes_back_from_disk_and_its_layers_are_a_network_on_a_grey_box(tmp_path):
    spec = Residual(units=UNITS)
    twin, commands, measured = sample_twin(spec)
    twin = drawn(twin, 0.3)
    save_twin(TwinBundle(spec, twin), tmp_path / "twin")
    again = load_twin(tmp_path).twin
    answers = [each.rollout(commands, each.initial_state(commands[:, 0], measured[:, 0]))[0] for each in (twin, again)]
    assert np.array_equal(*answers)
    plant = TwinPlant(twin, "a network on a grey box")
    rows = random_inputs(plant, 120, seed=4)
    exact = stream(copy.deepcopy(plant).double(), rows)
    assert np.abs((stream(plant, rows) - exact) / twin.scales.answer_width).max() < 1e-4
    assert np.abs(stream(TwinPlant(twin.drop_network(), ""), rows) - exact).max() > 1e-2
