"""How one episode lies in its rows."""

import numpy as np
import pytest

from edp.errors import ConfigError
from edp.sim import Scenario, load_machine
from edp.sim.episodes import blocks, tick
from edp.sim.episodes.episodes import Episodes, EpisodeStart
from edp.sim.physics import integrator

COLUMNS = np.arange(3)


def start_of(name="M22", **changes):
    scenario = Scenario(machine=name, duration_s=1.0, **changes)
    return EpisodeStart(scenario, scenario.load())


def test_scratch_is_cut_as_the_step_takes_it():
    parts = tick.scratch_of.py_func(np.zeros(tick.SCRATCH))
    assert [part.shape for part in parts] == [part.shape for part in integrator.new_work()]
    for number, part in enumerate(parts):
        part[...] = number
    # none lies in another
    assert [set(part.ravel().tolist()) for part in parts] == [{float(n)} for n in range(len(parts))]


def test_blocks_are_where_the_table_says():
    parts = {index: np.full((index % 3 + 1, index + 1), float(index)) for index in range(blocks.BLOCKS)}
    memory, drawn = blocks.rows_of(parts)
    for index, part in parts.items():
        np.testing.assert_array_equal(blocks.view(index, memory, drawn), part)
        row = memory if index < blocks.CHANGING else drawn
        np.testing.assert_array_equal(blocks.table.py_func(index, memory, row), part)
        np.testing.assert_array_equal(blocks.line.py_func(index, memory, row), part.ravel())
    assert len(memory) + len(drawn) == blocks.BLOCKS * blocks.ENTRY + sum(part.size for part in parts.values())


def test_rows_grow_when_a_longer_episode_comes_between_shorter_ones():
    episodes, alone = Episodes(2, COLUMNS), Episodes(1, COLUMNS)
    out, single = episodes.new_out(), alone.new_out()
    for index in range(2):
        episodes.begin(index, start_of(seed=index), out)
    alone.begin(0, start_of(seed=0), single)
    levers = np.array([[0.5, -0.5, 0.2]] * 2)
    for k in range(20):
        if k == 10:
            width = episodes.memory.shape[1]
            episodes.begin(1, start_of("C14", material="clay"), out)
            assert episodes.memory.shape[1] > width
        episodes.step(levers, out)
        alone.step(levers[:1], single)
        np.testing.assert_array_equal(out[0][0], single[0][0])


def test_inactive_episodes_rest():
    episodes = Episodes(2, COLUMNS)
    out = episodes.new_out()
    for index in range(2):
        episodes.begin(index, start_of(seed=index), out)
    before = episodes.memory.copy()
    episodes.step(np.full((2, 3), 0.7), out, np.array([True, False]))
    np.testing.assert_array_equal(episodes.memory[1], before[1])
    assert (episodes.ticks(0), episodes.ticks(1)) == (1, 0)


def test_dead_times_beyond_the_room_are_refused():
    scenario = Scenario(duration_s=0.02, rate_hz=1e4, step_s=1e-4)
    with pytest.raises(ConfigError, match="at most 256 are taken: choose a lower rate_hz"):
        Episodes(1, COLUMNS).begin(0, EpisodeStart(scenario, load_machine("M22")), Episodes(1, COLUMNS).new_out())


def test_what_has_not_begun_has_no_moment():
    with pytest.raises(ConfigError, match="episode 0 has not begun"):
        Episodes(1, COLUMNS).moment(0)
