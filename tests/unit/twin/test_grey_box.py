"""Grey boxes: exact tangents, physics that must hold, elements that must connect, numbers that a fit finds again."""

import json
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from edp.config.twin import load_twin_experiment, twin_toml
from edp.data.series import Series
from edp.data.twin_channels import twin_channels
from edp.errors import ConfigError
from edp.networks.twin import fit_scales
from edp.networks.twin.grey import parameter_index as at
from edp.networks.twin.grey.datasheet import datasheet
from edp.networks.twin.grey.elements import CylinderElement, Elements, ValveElement
from edp.networks.twin.grey.parameters import monomials, number_table
from edp.networks.twin.grey.priors import Travel
from edp.networks.twin.grey.rollouts import RunBatch
from edp.networks.twin.greybox import GreyBox, GreyFitSpec, RunTarget
from edp.networks.twin.parameters import Datasheet
from edp.storage.seals import HASH, content_digest
from edp.testing.bench import bench_channels, bench_grey_box, bench_series
from edp.testing.twins import sample_actuators
from edp.training import grey_fit
from edp.training.grey_fit import fit_grey_box
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin

PREFIX = 30


BENCH = bench_grey_box(
    prefix_ticks=PREFIX,
    fit=GreyFitSpec(
        lengths_s=(0.1, 0.4),
        rounds=(3, 2),
        final_rounds=6,
        batch=24,
        ticks=600,
        final_ticks=600,
        validation_s=2.0,
        validation_runs=4,
    ),
)


@pytest.fixture(scope="module")
def bench():
    """A grey box of the bench, and what it does on levers of its own: a machine with known numbers."""
    channels, levers = bench_channels(), [bench_series(seed=seed) for seed in range(4)]
    twin = BENCH.start(channels, fit_scales(channels, levers), levers, 0)
    table, numbers = twin.table, twin.table.nominal
    numbers[table.inertia_at], numbers[table.potential_at] = 0.07, 0.01  # 4.9 t, 20 kN
    machine = twin.with_parameters(numbers)
    start = np.tile(np.array([0.0, 0.5, 5e6, 5e6, 5e6], np.float32), (len(levers), 1))
    commands = np.stack([series.inputs for series in levers])
    state = machine.initial_state(commands[:, 0], start)
    answers, _ = machine.rollout(commands[:, :-1], state)
    rows = np.concatenate([start[:, None], answers], axis=1)
    return machine, [Series(f"run {i}", commands[i], rows[i]) for i in range(len(levers))]


def errors(twin, numbers, series, starts, full, ticks=8):
    """Matrix, gradient and losses of free runs of `ticks`."""
    rows = [slice(first, first + PREFIX + ticks + 1) for first in starts]
    values = np.stack([series.targets[row] for row in rows]) / twin.units
    demands = twin.demands(np.stack([series.inputs[row] for row in rows])[:, :-1])
    measured = values[:, :-1].copy()
    measured[:, PREFIX + 1 :] = np.nan
    rest = twin.rest(demands[:, 0], (measured[:, 0] * twin.units).astype(np.float32))
    state = (measured[:, 0].copy(), *(np.ascontiguousarray(part, dtype=np.float64) for part in rest))
    weight = twin.units / twin.scales.answer_width.astype(np.float64)
    target = RunTarget(np.ascontiguousarray(values[:, 1:]), weight, 1e9, PREFIX)
    normal = twin.evaluate_runs(numbers, RunBatch(demands, measured, *state), target, full)
    return normal.matrix, normal.gradient, normal.losses


@pytest.mark.long
def test_tangents_are_those_of_differences(bench):
    machine, runs = bench
    table = machine.table
    rng = np.random.default_rng(1)
    numbers = np.where(
        table.positive, machine.numbers * np.exp(rng.normal(0, 0.1, len(machine.numbers))), machine.numbers
    )
    # Away from a whole number of ticks, where the interpolated dead time has a corner.
    numbers[table.valve_at[0, at.DELAY]] = 0.0363
    starts = (60, 230, 410)
    _, gradient, _ = errors(machine, numbers, runs[1], starts, True)
    size = np.where(table.positive, np.abs(numbers), table.width)
    for which in range(len(numbers)):
        step = np.zeros(len(numbers))
        step[which] = 1e-5 * size[which]
        sides = [errors(machine, numbers + sign * step, runs[1], starts, False)[2].sum() for sign in (1, -1)]
        difference = (sides[0] - sides[1]) / 2e-5
        assert gradient[which] * size[which] == pytest.approx(
            difference, rel=2e-4, abs=2e-6 * np.abs(gradient * size).max()
        ), table.numbers[which].label


def test_oil_holds_a_load_behind_closed_spools_and_moves_it_behind_open_ones(bench):
    machine, _ = bench
    start = np.array([[0.0, 0.5, 6e6, 5e6, 3e6]], np.float32)
    moved = {}
    for lever in (-0.8, 0.0, 0.8):
        commands = np.full((1, 200, 1), lever, np.float32)
        answers, _ = machine.rollout(commands, machine.initial_state(0 * commands[:, 0], start))
        moved[lever] = answers[0, -1, 1] - answers[0, 20, 1]
    assert abs(moved[0.0]) < 5e-3
    assert moved[0.8] > 0.1
    assert moved[-0.8] < -0.1


@pytest.mark.long
def test_a_fit_finds_a_machine_again(bench):
    machine, runs = bench
    table = machine.table
    rng = np.random.default_rng(3)
    begin = machine.numbers.copy()
    for name in ("into_extend_25", "into_extend_45", "out_of_retract_25", "full_flow", "viscous"):
        which = [number.name for number in table.numbers].index(name)
        begin[which] *= np.exp(rng.choice([-0.4, 0.4]))
    before = errors(machine, begin, runs[3], (50, 300, 500), False, ticks=60)[2].sum()
    result = fit_grey_box(machine.with_parameters(begin), runs[:2], runs[2:3], seed=0)
    fitted = result.twin
    after = errors(machine, fitted.numbers, runs[3], (50, 300, 500), False, ticks=60)[2].sum()
    assert after < 0.05 * before
    best = [row["validation"] for row in result.history if row["best"]]
    assert best[-1] == min(row["validation"] for row in result.history)
    rows = {f"{row.element}.{row.name}": row for row in datasheet(table, fitted.numbers, result.information)}
    assert rows["pump.full_flow"].unit == "m^3/s"
    assert rows["valve.into_extend_25"].excited
    assert all(row.low <= row.value <= row.high for row in rows.values())
    # Nothing ran into a cushion of a stop, and no port relief opened.
    assert not rows["ram.head_relief"].excited
    assert "(" in Datasheet(basis="", numbers=tuple(rows.values())).to_text()


def test_finer_opening_curves_answer_as_the_coarser_ones_they_were_made_of(bench):
    machine, runs = bench
    commands = np.stack([series.inputs for series in runs])[:, :400]
    start = np.stack([series.targets[0] for series in runs])
    answers = machine.rollout(commands, machine.initial_state(commands[:, 0], start))[0]
    for stretches in (10, 20):
        finer = machine.with_stretches(stretches)
        assert len(finer.table.knots) == stretches + 1
        assert set(machine.table.knots) <= set(finer.table.knots)
        assert len(finer.numbers) == len(machine.numbers) + 4 * (stretches - 5)
        again = finer.rollout(commands, finer.initial_state(commands[:, 0], start))[0]
        np.testing.assert_allclose(
            again / machine.scales.answer_width, answers / machine.scales.answer_width, atol=1e-3
        )
    with pytest.raises(ValueError, match="a multiple of 10"):
        machine.with_stretches(10).with_stretches(5)
    with pytest.raises(ConfigError, match="curve_segments = 7; any of 5, 10, 20, or 0"):
        replace(BENCH, curve_segments=7)


@pytest.mark.long
def test_free_runs_choose_how_many_stretches_an_opening_curve_has(bench):
    """A machine whose curves bend within the coarse stretches is fitted better by the finer ones."""
    machine, runs = bench
    free = replace(BENCH, curve_segments=0, fit=replace(BENCH.fit, final_rounds=16))
    arrays = {"numbers": machine.numbers.astype(np.float32), "full": machine.full}
    coarse = free.build(machine.channels, machine.scales, arrays)
    bent = machine.with_stretches(10)
    weights = np.where(np.arange(40) % 2, 1.9, 0.1)
    bent.numbers[bent.table.is_in_curves] *= weights
    told = []
    for series in runs:
        start = series.targets[:1]
        answers = bent.rollout(series.inputs[None, :-1], bent.initial_state(series.inputs[:1], start))[0][0]
        told.append(Series(series.name, series.inputs, np.concatenate([start, answers])))
    result = fit_grey_box(coarse, told[:2], told[2:3], seed=0)
    tried = {row["stretches"] for row in result.history}
    assert tried >= {5, 10}
    kept = result.twin.spec.curve_segments
    assert kept in (10, 20)
    assert result.error == min(row["validation"] for row in result.history if row["stretches"] == kept)
    assert len(result.information) == len(result.twin.numbers) == len(result.theta)
    names = {row.name for row in datasheet(result.twin.table, result.twin.numbers, result.information)}
    assert {"into_extend_5", "into_extend_17.5", "into_extend_100"} <= names


@pytest.mark.long
def test_a_curve_that_gains_too_little_stays_coarse(bench, monkeypatch):
    machine, runs = bench
    monkeypatch.setattr(grey_fit, "MIN_GAIN", 1.0)
    arrays = {"numbers": machine.numbers.astype(np.float32), "full": machine.full}
    fit = replace(BENCH.fit, lengths_s=(0.1,), rounds=(1,), starts=1)
    begun = replace(BENCH, curve_segments=0, fit=fit).build(machine.channels, machine.scales, arrays)
    result = fit_grey_box(begun, runs[:2], runs[2:3], seed=0)
    assert result.twin.spec.curve_segments == 5
    assert {row["stretches"] for row in result.history} == {5, 10}


def test_a_bundle_that_names_no_stretches_has_five(bench, tmp_path):
    machine, _ = bench
    save_twin(TwinBundle(BENCH, machine), tmp_path / "old")
    path = tmp_path / "old" / "twin.json"
    header = json.loads(path.read_text())
    # As bundles were written before: the key is not there.
    assert header["twin"].pop("curve_segments") == 5
    del header[HASH]
    path.write_text(json.dumps(header | {HASH: content_digest(header)}))
    old = load_twin(tmp_path / "old").twin
    assert old.table.stretches == 5
    np.testing.assert_array_equal(old.numbers, machine.numbers)
    finer = machine.with_stretches(20)
    save_twin(TwinBundle(finer.spec, finer), tmp_path / "new")
    again = load_twin(tmp_path / "new").twin
    assert again.spec.curve_segments == again.table.stretches == 20
    np.testing.assert_array_equal(again.numbers, finer.numbers.astype(np.float32))


@pytest.mark.long
def test_what_is_left_out_does_nothing_and_is_not_fitted(bench):
    machine, runs = bench
    parts = ("power_limit", "cushions", "play")
    spec = replace(BENCH, omit=parts)
    scales = machine.scales
    bare = spec.build(machine.channels, scales, {"numbers": machine.numbers.astype(np.float32), "full": machine.full})
    names = [number.name for number in bare.table.numbers]
    numbers = np.where(bare.table.width == 0.0, bare.table.nominal, machine.numbers)
    bare = bare.with_parameters(numbers)
    # As little as the equations with the parts in them do when those are out of reach.
    far = machine.numbers.copy()
    for name, value in (("power_limit", 1e4), ("cushion_least", 1.0), ("play", 1e-12)):
        far[names.index(name)] = value
    commands = np.stack([series.inputs for series in runs])[:, :-1]
    start = np.stack([series.targets[0] for series in runs])
    answers, other, whole = (
        twin.rollout(commands, twin.initial_state(commands[:, 0], start))[0]
        for twin in (bare, machine.with_parameters(far), machine)
    )
    width = scales.answer_width
    np.testing.assert_allclose(answers / width, other / width, atol=1e-4)
    assert np.abs((answers - whole) / width).max() > 1e-2
    fit = replace(BENCH.fit, lengths_s=(0.1,), rounds=(1,), starts=2)
    fresh = replace(spec, fit=fit).start(machine.channels, scales, runs[:2], 0)
    result = fit_grey_box(fresh, runs[:2], runs[2:3], seed=0)
    fixed = bare.table.width == 0.0
    assert fixed.sum() == 4
    np.testing.assert_array_equal(result.twin.numbers[fixed], bare.numbers[fixed])
    assert not np.array_equal(result.twin.numbers, fresh.numbers)
    rows = datasheet(bare.table, result.twin.numbers, result.information)
    assert not {row.name for row in rows} & {"power_limit", "cushion_length", "cushion_least", "play"}


def test_a_part_that_cannot_be_left_out_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"omit names 'cushion'.*cushions.*power_limit, cushions, play must hold"):
        GreyBox(omit=("cushion",))


def test_monomials_are_sorted_by_degree():
    assert monomials(2, 2).tolist() == [[0, 0], [1, 0], [0, 1], [2, 0], [1, 1], [0, 2]]
    assert len(monomials(3, 4)) == 35
    for variables, degree in ((1, 3), (3, 4), (4, 2)):
        every = [e for e in product(range(degree + 1), repeat=variables) if sum(e) <= degree]
        assert monomials(variables, degree).tolist() == sorted(
            map(list, every), key=lambda e: (sum(e), [-x for x in e])
        )


def elements_of(cylinders, valves=0):
    actuators = tuple(CylinderElement(name=f"c{i}", velocity=f"v{i}") for i in range(cylinders))
    spools = tuple(ValveElement(name=f"x{i}", actuator="c0", extend="lever") for i in range(valves))
    return Elements((), actuators, spools)


def test_a_load_of_too_many_parameters_is_refused():
    with pytest.raises(ConfigError, match=r"load of 12 cylinders .* numbers; at most 5,000 must hold: lower"):
        number_table(elements_of(12), [Travel(0.0, 1.0, 1.0, (1.0, 1.0))] * 12, [], (2, 6))


@pytest.mark.parametrize(("cylinders", "valves"), [(13, 0), (40, 3), (2000, 0), (1, 49)])
def test_too_many_elements_are_refused_before_their_parameters_are_made(cylinders, valves):
    """A file of a few kilobytes may ask for them; their equations would take minutes and gigabytes to compile."""
    message = rf"got {cylinders:,} cylinders and motors and {valves} valves, expected at most 12 and 48; leave channels"
    with pytest.raises(ConfigError, match=message):
        number_table(elements_of(cylinders, valves), [Travel(0.0, 1.0, 1.0, (1.0, 1.0))] * cylinders, [], (0, 1))


def test_elements_of_a_settings_file_come_back(tmp_path):
    text = """
[twin]
kind = "greybox"
cylinders = [{ name = "ram", velocity = "speed", bore = 0.1, rod_diameter = 0.05 }]
valves = [{ name = "valve", actuator = "ram", extend = "lever" }]
"""
    (tmp_path / "bench.toml").write_text(text)
    experiment = load_twin_experiment(tmp_path / "bench.toml")
    (tmp_path / "again.toml").write_text(twin_toml(experiment))
    assert load_twin_experiment(tmp_path / "again.toml") == experiment
    assert experiment.twin.cylinders[0].areas == pytest.approx((np.pi / 400, np.pi / 400 * 0.75))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"valves": ()}, "cylinder 'ram' has no valve"),
        ({"pumps": ()}, "port 'supply' of valve 'valve' is 'pump', which is no pump of this twin"),
        (
            {"valves": (ValveElement(name="valve", actuator="rma", extend="lever"),)},
            "port 'actuator' of valve 'valve' is 'rma', which is no cylinder of this twin.*ram",
        ),
        (
            {"valves": (ValveElement(name="valve", actuator="ram", extend="levre"),)},
            "port 'extend' of valve 'valve' is 'levre', which is no command.*lever",
        ),
        (
            {"cylinders": (CylinderElement(name="ram", velocity="speed", head="head", rod="head"),)},
            "'head' is connected to cylinder 'ram' and to cylinder 'ram', port 'rod'",
        ),
        (
            {"cylinders": (CylinderElement(name="ram", velocity="speed", head="head"),)},
            "no element has the channel 'rod'",
        ),
    ],
)
def test_elements_that_do_not_connect_are_named(changes, message):
    fields = {"cylinders": BENCH.cylinders, "valves": BENCH.valves, "pumps": BENCH.pumps} | changes
    with pytest.raises(ConfigError, match=message):
        GreyBox(**fields).shapes(bench_channels())


def test_a_rod_as_thick_as_its_bore_is_refused():
    with pytest.raises(ConfigError, match=r"rod_diameter = 0\.1 m is not below bore"):
        CylinderElement(name="ram", velocity="speed", bore=0.1, rod_diameter=0.1)


def test_names_and_kinds_tell_the_elements_of_sample_actuators():
    elements = GreyBox().elements(twin_channels(sample_actuators()))
    assert [(c.velocity, c.head, c.rod) for c in elements.cylinders] == [
        ("speed_1", "pressure_1", ""),
        ("speed_2", "pressure_2", ""),
    ]
    assert [(v.extend, v.supply) for v in elements.valves] == [("lever_1", ""), ("lever_2", "")]
