"""A ground under a grey box: kinematics, forces that only brake, a law found again in its own forces, files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from grey_front import ORDER, PREFIX, front, front_channels, series_of

from edp.control.geometry import TipGeometry
from edp.errors import BundleError, ConfigError, DataError, ExportError
from edp.networks.twin import fit_scales
from edp.networks.twin.grey import ground_contact as contact
from edp.networks.twin.grey.ground import GROUNDS, GroundedRunner, check_grounded
from edp.networks.twin.grey.ground_drag import DragLaw
from edp.networks.twin.static_map import StaticMap
from edp.sim.machine.machine_files import load_machine
from edp.storage.seals import HASH, content_digest
from edp.training.ground_fit import read_forces
from edp.training.twin_bundle import GROUNDED, TwinBundle, load_twin, plant_bundle, save_twin

MACHINE = load_machine("m22")
GEOMETRY = TipGeometry(MACHINE)
PLACES = [("boom", "arm", "bucket").index(name) for name in ORDER]
"""Of the machine's cylinders in the order of the twin's."""
NUMBERS = np.array([3e4, 5e4, 2e4, 1e4, 3e4, 1e4, 2e4, 4e4, 2e4, 5e3, 1e4, 1e4, -2e4])


@pytest.fixture(scope="module")
def twin():
    """Its load is that of M22; everything else plausible."""
    channels, series = front_channels(), [series_of()]
    made = front().start(channels, fit_scales(channels, series), series, 0)
    return made.with_parameters(made.table.nominal)


@pytest.fixture(scope="module")
def law():
    return DragLaw(NUMBERS, 0.1 * np.abs(NUMBERS), float(MACHINE.bodies.length[2]), GEOMETRY.ground_m)


def strokes_of(poses):
    """Strokes of tip poses in the order of the twin's cylinders."""
    strokes, reached = GEOMETRY.strokes(np.asarray(poses, float))
    assert reached.all()
    return strokes[..., PLACES]


def passes(count=6, ticks=150, depth=0.15, seed=0):
    """Strokes and velocities of passes through the ground: inwards, outwards, down and up."""
    rng = np.random.default_rng(seed)
    rows = []
    for n in range(count):
        along = np.linspace(0.0, 1.0, ticks)
        x = (6.6 - 1.4 * along if n % 2 else 5.6 + 0.8 * along) + 0.05 * rng.normal()
        y = GEOMETRY.ground_m - depth + 1.4 * depth * np.cos(2 * np.pi * (along + rng.random()))
        rows.append(np.stack([x, y, np.full(ticks, np.radians(-80.0))], axis=1))
    return [(strokes, np.gradient(strokes, 0.01, axis=0)) for strokes in map(strokes_of, rows)]


def test_the_tip_and_its_depth_are_those_of_the_machine(twin, law):
    [(strokes, velocities)] = passes(1)
    tips, terms = np.empty((len(strokes), 2)), np.empty((len(strokes), contact.NUMBERS, 3))
    contact.follow(law._front(twin), strokes, velocities, law._level(twin), tips, terms)
    poses = GEOMETRY.tip(strokes[:, np.argsort(PLACES)])
    # Outwards nothing is cut, so that depth is that below level ground.
    assert tips[:, 0] == pytest.approx(GEOMETRY.ground_m - poses[:, 1], abs=1e-4)
    speeds = np.hypot(*np.gradient(poses[:, :2], 0.01, axis=0).T)
    assert tips[2:-2, 1] == pytest.approx(speeds[2:-2], abs=5e-3)
    assert (terms[tips[:, 0] <= 0.0] == 0.0).all()


def test_a_ground_only_brakes_whatever_its_numbers(twin, law):
    rng = np.random.default_rng(1)
    slopes = -1e-6 * np.eye(3)
    for _ in range(50):
        numbers = np.concatenate([rng.uniform(0.0, 2e5, contact.ACROSS), rng.uniform(-2e5, 2e5, 1)])
        ground = replace(law, numbers=numbers).contact(twin)
        strokes = strokes_of([rng.uniform(4.5, 7.0), GEOMETRY.ground_m - rng.uniform(0.01, 0.3), np.radians(-80.0)])
        free = rng.uniform(-0.4, 0.4, 3)
        assert ground.touches(strokes, free)
        forces = ground.forces(strokes, free, slopes)
        left = free + slopes @ forces
        assert np.isfinite(forces).all()
        assert forces @ left >= -1e-9
        assert np.linalg.norm(left) <= np.linalg.norm(free) + 1e-12


def test_an_edge_cuts_what_it_passes_towards_the_machine(twin, law):
    ground = law.contact(twin)
    slopes, free = -1e-6 * np.eye(3), np.zeros(3)
    for x in (6.0, 5.9, 5.8, 5.7):
        ground.forces(strokes_of([x, GEOMETRY.ground_m - 0.2, np.radians(-80.0)]), free, slopes)
    behind = strokes_of([5.9, GEOMETRY.ground_m - 0.15, np.radians(-80.0)])
    outwards = np.linalg.pinv(_slopes_of(behind)) @ np.array([0.3, 0.0])
    assert not ground.touches(behind, outwards)
    assert law.contact(twin).touches(behind, outwards)


def _slopes_of(strokes):
    step = 1e-4
    shifted = [
        GEOMETRY.tip((strokes + side * step * np.eye(3)[k])[np.argsort(PLACES)])[:2]
        for k in range(3)
        for side in (1, -1)
    ]
    return np.array([(shifted[2 * k] - shifted[2 * k + 1]) / (2 * step) for k in range(3)]).T


def test_a_law_is_found_again_in_its_own_forces(twin, law):
    rng = np.random.default_rng(2)
    logs = []
    for strokes, velocities in passes(10):
        tips, terms = np.empty((len(strokes), 2)), np.empty((len(strokes), contact.NUMBERS, 3))
        contact.follow(law._front(twin), strokes, velocities, law._level(twin), tips, terms)
        lagged = np.zeros((len(strokes), 3))
        for t in range(1, len(strokes)):
            lagged[t] = lagged[t - 1] + 0.3 * (law.numbers @ terms[t] - lagged[t - 1])
        logs.append((strokes, velocities, lagged + 500.0 * rng.normal(size=lagged.shape)))
    found = DragLaw.from_logs(twin, logs, "m22")
    assert found.r_squared(twin, logs) > 0.98
    edges = [contact.INWARDS, contact.OUTWARDS, contact.DOWN]
    assert found.numbers[edges] == pytest.approx(law.numbers[edges], rel=0.3)
    rows = found.rows()
    assert [row.name for row in rows[:2]] == ["inwards_edge", "inwards_by_depth"]
    assert all(row.low <= row.value <= row.high for row in rows)
    with pytest.raises(DataError, match="moves below the surface"):
        DragLaw.from_logs(
            twin, [(strokes_of([[6.0, 2.0, -1.4]] * 700), np.full((700, 3), 0.1), np.zeros((700, 3)))], "m22"
        )


def test_a_grounded_machine_is_slower_in_the_ground_and_the_same_above(twin, law):
    levers = np.zeros(3, np.float32)
    levers[ORDER.index("arm")] = 0.6
    free = np.full(len(twin.channels.answers), np.nan, np.float32)
    ends = {}
    for height in (-0.3, 2.0):
        strokes = strokes_of([6.0, GEOMETRY.ground_m + height, np.radians(-80.0)])
        start = np.concatenate([np.zeros(3), strokes, np.full(7, 3e6)]).astype(np.float32)
        state = twin.reset(np.zeros((1, PREFIX, 3), np.float32), np.tile(start, (1, PREFIX, 1)))
        for name, runner in (("free", twin.runner()), ("grounded", GroundedRunner(twin, law))):
            now = state
            for _ in range(60):
                now = runner.step(levers, now, free)
            ends[height, name] = now["answer"][0]
    assert np.isfinite(ends[-0.3, "grounded"]).all()
    arm = ORDER.index("arm")
    moved = {name: abs(ends[-0.3, name][3 + arm]) for name in ("free", "grounded")}
    begun = strokes_of([6.0, GEOMETRY.ground_m - 0.3, np.radians(-80.0)])[arm]
    assert abs(moved["grounded"] - begun) < 0.9 * abs(moved["free"] - begun)
    assert (ends[2.0, "grounded"] == ends[2.0, "free"]).all()


def test_forces_along_a_log_that_the_twin_made_are_small(twin):
    series = series_of(ticks=PREFIX + 60)
    strokes = strokes_of([6.0, GEOMETRY.ground_m + 2.0, np.radians(-80.0)])
    start = np.concatenate([np.zeros(3), strokes, np.full(7, 3e6)]).astype(np.float32)
    state = twin.reset(series.inputs[None, :PREFIX], np.tile(start, (1, PREFIX, 1)))
    answers, _ = twin.rollout(series.inputs[None, PREFIX:], state)
    rows = np.concatenate([np.tile(start, (PREFIX, 1)), answers[0]])
    # Row t of a log is the machine before the command of row t.
    log = replace(series, targets=np.concatenate([rows[:1], rows[:-1]]))
    places, speeds, forces = read_forces(twin, log)
    assert places.shape == speeds.shape == forces.shape == (60, 3)
    assert np.median(np.abs(forces[20:])) < 1e3


def test_a_bundle_keeps_its_ground_and_exports_refuse_it(twin, law, tmp_path):
    bundle = TwinBundle(twin.spec, twin, ground=replace(law, deviations=np.append(law.deviations[:-1], np.inf)))
    save_twin(bundle, tmp_path / "twin")
    again = load_twin(tmp_path / "twin").ground
    assert isinstance(again, DragLaw)
    assert again.to_dict() == bundle.ground.to_dict()
    assert again.rows()[-1].excited is False
    with pytest.raises(ExportError, match=r"the twin has a ground \('drag'\), which exported forms do not have"):
        plant_bundle(bundle)


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"kind": "mud"}, "unknown ground 'mud'"),
        ({"kind": ["drag"]}, "unknown ground"),
        ({"numbers": [1.0] * 12}, "has not 13 numbers"),
        ({"numbers": [-1.0] + [1.0] * 12}, "negative or not finite"),
        ({"numbers": [None] + [1.0] * 12}, "negative or not finite"),
        ({"numbers": ["1e9"] * 12 + [{}]}, "damaged"),
        ({"deviations": [-1.0] * 13}, "negative or not finite"),
        ({"bucket_m": True}, "no machine has"),
        ({"bucket_m": 1e9}, "no machine has"),
        ({"surface_m": None}, "no machine has"),
    ],
)
def test_a_damaged_ground_is_one_error(changes, says, twin, law, tmp_path):
    path = save_twin(TwinBundle(twin.spec, twin, ground=law), tmp_path / "twin") / "twin.json"
    header = json.loads(path.read_text())
    assert header["schema"] == GROUNDED
    header["ground"] |= changes
    del header[HASH]
    path.write_text(json.dumps(header | {HASH: content_digest(header)}))
    with pytest.raises(BundleError, match=says):
        load_twin(tmp_path / "twin")


def test_what_carries_no_ground_is_refused():
    channels, series = front_channels(), [series_of()]
    static = StaticMap(prefix_ticks=PREFIX).start(channels, fit_scales(channels, series), series, 0)
    with pytest.raises(ConfigError, match="a ground acts on a grey box with a known linkage"):
        check_grounded(static)
    assert list(GROUNDS) == ["drag"]
