"""Damped Gauss-Newton steps: curved valleys, priors, memory, bounds of a step, and losses that are not finite."""

import numpy as np
import pytest

from edp.networks.twin.descent import DescentLimits, NormalEquations, descend
from edp.networks.twin.parameters import Parameter, Priors


def least_squares(errors, slopes):
    """A problem of errors and their slopes by the coordinates."""

    def problem(theta, full):
        error = errors(theta)
        jacobian = slopes(theta) if full else np.zeros((len(error), 0))
        return NormalEquations(jacobian.T @ jacobian, jacobian.T @ error, 0.5 * error**2)

    return problem


VALLEY = least_squares(
    lambda x: np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0]]),
    lambda x: np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0]]),
)
LINE = least_squares(lambda x: 3.0 * (x - 2.0), lambda x: 3.0 * np.eye(1))


def test_a_curved_valley_is_followed_to_its_end():
    descent = descend(VALLEY, np.array([-1.2, 1.0]), DescentLimits(60, prior=0.0))
    assert descent.theta == pytest.approx([1.0, 1.0], abs=1e-6)
    assert descent.cost < 1e-12


def test_the_prior_pulls_to_zero_and_memory_to_the_beginning():
    assert descend(LINE, np.zeros(1), DescentLimits(20)).theta == pytest.approx([1.8])
    memory = np.array([[9.0]])
    assert descend(LINE, np.full(1, 4.0), DescentLimits(20), memory=memory).theta == pytest.approx([54.0 / 19.0])


def test_a_step_moves_no_coordinate_farther_than_its_radius():
    assert descend(LINE, np.zeros(1), DescentLimits(1, radius=0.25)).theta == pytest.approx([0.25])


def test_losses_that_are_not_finite_are_left():
    def problem(theta, full):
        equations = LINE(theta, full)
        return (
            equations if theta[0] < 1.0 else NormalEquations(equations.matrix, equations.gradient, np.full(1, np.nan))
        )

    descent = descend(problem, np.zeros(1), DescentLimits(30), damping=1e-3)
    assert 0.9 < descent.theta[0] < 1.0


def test_a_descent_ends_where_steps_gain_nothing():
    calls = []

    def problem(theta, full):
        calls.append(full)
        return LINE(theta, full)

    descend(problem, np.zeros(1), DescentLimits(50, ftol=1e-3), damping=1e-6)
    assert sum(calls) <= 3


def test_slopes_by_coordinates_are_those_of_differences_and_followers_move_with_their_leader():
    parameters = [
        Parameter("a", "positive", "m", 1.0, 2.0, 0.5),
        Parameter("a", "follower", "m", 1.0, 2.0, 0.5, leader=1),
        Parameter("b", "signed", "m", 1.0, -1.0, 3.0, positive=False),
        Parameter("b", "fixed", "m", 1.0, 4.0, 0.0, positive=False),
    ]
    priors, theta = Priors.from_parameters(parameters), np.array([0.3, 0.0, -0.2, 5.0])
    values = priors.values(theta)
    assert values == pytest.approx([2.0 * np.exp(0.15)] * 2 + [-1.6, 4.0])
    weights = np.array([1.0, 2.0, 3.0, 4.0])
    by_values = NormalEquations(np.outer(weights, weights), weights, np.zeros(1))
    gradient = priors.transform(by_values, theta).gradient
    steps = 1e-6 * np.eye(4)
    differences = [weights @ (priors.values(theta + step) - priors.values(theta - step)) / 2e-6 for step in steps]
    assert gradient == pytest.approx(differences, abs=1e-8)
    assert priors.transform(by_values, theta).matrix == pytest.approx(np.outer(gradient, gradient))
