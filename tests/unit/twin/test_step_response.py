"""Step responses of a twin, and the figure of its page that shows them."""

import numpy as np
import pytest

from edp.errors import StorageError
from edp.evaluation.free_run_file import StepResponses
from edp.evaluation.step_response import POINTS, step_responses
from edp.networks.twin import TWINS
from edp.report.twin.charts import steps_chart
from edp.report.twin.facts import read_steps
from edp.storage import write_json
from edp.testing.twins import sample_actuators, sample_twin


@pytest.fixture(scope="module")
def content():
    spec = TWINS["static"]()
    twin = sample_twin(spec, sample_actuators(600))[0]
    series = [twin.channels.task().series(sample_actuators(600, seed=seed)) for seed in (0, 1)]
    return twin, series, step_responses(twin, series)


def test_a_response_is_the_difference_between_two_free_runs(content):
    twin, series, found = content
    assert found.moments > 1
    assert len(found.seconds) <= POINTS
    assert len(found.steps) == len(twin.channels.commands)
    names = [channel.name for channel in twin.channels.answers]
    for column, step in enumerate(found.steps):
        assert [answer.name for answer in step.answers] == names
        values = np.concatenate([part.inputs[:, column] for part in series])
        span = np.quantile(values, 0.95) - np.quantile(values, 0.05)
        assert step.size > 0.0
        assert span > 0.0
        for answer in step.answers:
            middle, low, high = (np.array(getattr(answer, key)) for key in ("median", "low", "high"))
            assert np.isfinite(middle).all()
            assert (low <= high + 1e-9).all()
    # A static map of commands answers its own axis at once, and its stroke goes on from there.
    own = found.steps[0].answers
    velocity = np.abs(own[0].median)
    assert velocity[-1] > 0.0


def test_a_command_that_never_moves_has_no_response(content):
    twin, series, _ = content
    from dataclasses import replace

    still = [replace(part, inputs=np.zeros_like(part.inputs)) for part in series]
    found = step_responses(twin, still)
    assert found.steps == ()
    assert steps_chart(found) is None


def test_what_is_on_disk_is_drawn_a_choice_for_each_command(content, tmp_path):
    _, _, found = content
    assert read_steps(tmp_path) is None
    found.write(tmp_path)
    chart = steps_chart(read_steps(tmp_path))
    assert [value for value, _ in chart.choices[0].options] == [step.command for step in found.steps]
    assert len(chart.panels) == min(6, len(found.steps[0].answers))
    damaged = found.to_table()
    damaged["steps"][0]["answers"][0]["median"].pop()
    write_json(tmp_path / StepResponses.NAME, damaged)
    with pytest.raises(StorageError, match="other lengths"):
        read_steps(tmp_path)
