"""Keeping and restoring a simulation, exactly, and branching it."""

import json

import numpy as np
import pytest

from edp.errors import StorageError
from edp.sim import EXCITATIONS, Scenario, Simulation, SimulationError, Snapshot, simulate

FAMILIES = [(family, "") for family in EXCITATIONS] + [("grading", "clay"), ("dig", "sandy_loam")]


def scenario_of(family, **changes):
    return Scenario(**{"excitation": family, "duration_s": 12.0, "seed": 6, **changes})


@pytest.mark.parametrize(("family", "material"), FAMILIES)
def test_running_in_pieces_and_going_on_from_a_snapshot_give_the_same_bits(family, material, tmp_path):
    whole = simulate(scenario_of(family, material=material))
    pieces = Simulation(scenario_of(family, material=material))
    pieces.run(333)
    moment = pieces.snapshot()
    rest = pieces.run(867)
    np.testing.assert_array_equal(pieces.recording().values, whole.values)

    pieces.restore(moment)
    np.testing.assert_array_equal(pieces.run(867), rest)

    again = Simulation.from_snapshot(Snapshot.load(moment.save(tmp_path / "moment.npz")))
    again.run(867)
    assert again.recording().digest == whole.digest
    assert again.recording().meta == whole.meta


@pytest.mark.long
@pytest.mark.parametrize(("family", "material"), FAMILIES)
def test_branches_share_the_past_and_differ_later(family, material):
    simulation = Simulation(scenario_of(family, material=material, duration_s=60.0))
    simulation.run(1000)
    moment = simulation.snapshot()
    futures = []
    for seed in (1, 1, 2):
        simulation.restore(moment)
        simulation.branch(np.random.SeedSequence(seed))
        rows = simulation.run(2500)
        futures.append(rows)
        np.testing.assert_array_equal(rows[0, :9], futures[0][0, :9])
    np.testing.assert_array_equal(futures[0], futures[1])
    assert np.abs(futures[0] - futures[2]).max() > 0


def test_a_snapshot_is_not_changed_by_what_follows():
    simulation = Simulation(scenario_of("dig"))
    simulation.run(200)
    moment = simulation.snapshot()
    kept = [array.copy() for array in moment.arrays], json.dumps(moment.state)
    simulation.run(500)
    simulation.restore(moment)
    simulation.run(300)
    assert all((a == b).all() for a, b in zip(kept[0], moment.arrays, strict=True))
    assert json.dumps(moment.state) == kept[1]
    assert moment.samples == 200


def test_known_commands_give_the_future_they_gave():
    simulation = Simulation(scenario_of("combined"))
    simulation.run(300)
    moment = simulation.snapshot()
    simulation.restore(moment)
    future = simulation.run(400)
    commands = simulation.targets
    simulation.restore(moment)
    np.testing.assert_array_equal(simulation.follow(commands), future)


def test_snapshots_of_others_and_damaged_files_are_refused(tmp_path):
    simulation = Simulation(scenario_of("combined"))
    simulation.run(50)
    with pytest.raises(SimulationError, match="belongs to scenario"):
        Simulation(scenario_of("isolated")).restore(simulation.snapshot())
    file = simulation.snapshot().save(tmp_path / "moment.npz")
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(StorageError, match="not a snapshot"):
        Snapshot.load(file)
    with pytest.raises(StorageError, match="cannot be read: No such file"):
        Snapshot.load(tmp_path / "absent.npz")


def test_what_is_held_lasts_as_long_as_it_may():
    from edp.sim.excitation.base import Hold

    rng = np.random.default_rng(0)
    hold = Hold(rng, 100.0)
    lengths = []
    for _ in range(2000):
        total = hold.start(0.25, 1.6)
        hold.spend(min(total, 50))
        if hold.left == 0:
            continue
        hold.redraw(0)
        lengths.append(50 + hold.left)
    assert min(lengths) >= 51
    assert max(lengths) <= 161
    assert np.mean(lengths) == pytest.approx(105, abs=3)
