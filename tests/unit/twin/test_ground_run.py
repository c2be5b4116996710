"""A ground from logs in soil to a loop: run folder, datasheet, what acts with a material, what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest
from sample_scores import sample_errors, sample_free_run_scores

from edp.config.twin import load_twin_experiment
from edp.control.plants import plant_of
from edp.control.twin_environment import TwinEnvironment
from edp.errors import ConfigError, ExportError
from edp.jobs import IN_PROCESS
from edp.logs.source import DataSource
from edp.networks.twin.grey.ground_drag import DragLaw
from edp.networks.twin.static_map import StaticMap
from edp.report.twin.facts import ground_line
from edp.settings.results import plain_value
from edp.sim.data_set import SimulationOrder, simulate_data_set
from edp.storage import write_json
from edp.testing.control import sample_excavator_twin, sample_grey_box
from edp.training.twin_bundle import TwinBundle, load_twin, save_twin
from edp.workflows.deployment import load_exported
from edp.workflows.twin import train_twin
from edp.workflows.twin.ground_twin import JUDGED

pytestmark = pytest.mark.processes

GROUND = ("ground=drag", "evaluation.baselines=[]")


@pytest.fixture(scope="module")
def start(tmp_path_factory):
    """A run folder of a grey box that nobody fitted, with a datasheet of a row."""
    run = tmp_path_factory.mktemp("start")
    scores = plain_value({"twin": sample_free_run_scores(sample_errors(1.0, 1.0))})
    save_twin(replace(sample_grey_box(), scores=scores), run / "twin")
    row = {"element": "pump", "name": "flow", "unit": "m^3/s", "value": 1.0, "low": 0.9, "high": 1.1, "excited": True}
    write_json(run / "datasheet.json", {"schema": 1, "basis": "", "numbers": [row]})
    for name in JUDGED:
        (run / name).write_bytes(f"what judged {name}".encode())
    return run


@pytest.fixture(scope="module")
def loam(tmp_path_factory):
    folder = tmp_path_factory.mktemp("loam")
    order = SimulationOrder(minutes=2.0, recordings=4, seed=3, mix={"dig": 1.0}, materials={"sandy_loam": 1.0})
    simulate_data_set(folder, order, workers=IN_PROCESS)
    return DataSource.from_path(folder)


@pytest.fixture(scope="module")
def grounded(start, loam, tmp_path_factory):
    run = tmp_path_factory.mktemp("grounded") / "run"
    return run, train_twin(loam, load_twin_experiment(None, GROUND), run, start=start)


def test_a_run_with_a_ground_keeps_equations_and_scores(grounded, start, loam):
    run, trained = grounded
    before, after = load_twin(start), load_twin(run)
    assert isinstance(after.ground, DragLaw)
    assert all((after.twin.arrays()[name] == values).all() for name, values in before.twin.arrays().items())
    assert after.scores == before.scores == plain_value(trained.scores)
    facts = after.provenance.more["ground"]["explained"]
    assert set(facts) == {"train", "validation"}
    rows = json.loads((run / "datasheet.json").read_text())["numbers"]
    assert [row["element"] for row in rows] == ["pump", *["ground"] * 13]
    assert "ground.inwards_edge" in (run / "datasheet.txt").read_text()
    # The page of a run needs no evaluation before it.
    assert all((run / name).read_bytes() == (start / name).read_bytes() for name in JUDGED)
    assert ground_line(after.provenance).startswith("ground 'drag': explains ")
    assert train_twin(loam, load_twin_experiment(None, GROUND), run, start=start).resumed


def test_exports_of_a_run_with_a_ground_name_the_way_out(grounded):
    with pytest.raises(ExportError, match=r"exported forms do not have; export the run in free air"):
        load_exported(grounded[0])


def test_a_ground_acts_where_a_material_is_named(grounded):
    env = plant_of("M22", 5.0, 100.0, grounded[0])
    strokes = (0.35, 0.5, 0.5)
    ends = {}
    for material in ("", "sandy_loam", "", "sandy_loam"):
        _, info = env.reset(options={"strokes": strokes, "material": material})
        for _ in range(250):
            row, _, _, _, info = env.step([-0.5, 0.0, 0.0])
        tip = info["truth"]["TipY"]
        assert np.isfinite(row).all()
        # A new episode has ground that nothing has cut.
        assert ends.setdefault(material, tip) == tip
    assert ends["sandy_loam"] > ends[""] + 0.05


@pytest.mark.parametrize(
    ("settings", "from_start", "says"),
    [
        (("ground=mud",), True, "ground = 'mud'"),
        (GROUND, False, "a grey box of logs in free air comes first; name its run with --start"),
        ((*GROUND, "twin.kind=recurrent"), True, "the formulation is that of the twin there"),
    ],
)
def test_settings_that_cannot_be_are_refused(settings, from_start, says, start, loam, tmp_path):
    with pytest.raises(ConfigError, match=says):
        train_twin(loam, load_twin_experiment(None, settings), tmp_path / "run", start=start if from_start else None)
    assert not (tmp_path / "run").exists()


def test_twins_without_a_load_carry_no_ground(loam, grounded, tmp_path):
    static = sample_excavator_twin()
    law = load_twin(grounded[0]).ground
    with pytest.raises(ConfigError, match="a ground acts on a grey box"):
        TwinEnvironment(static, "M22", 1.0, law)
    save_twin(TwinBundle(StaticMap(), static), tmp_path / "static" / "twin")
    with pytest.raises(ConfigError, match=r"the twin is of kind 'static'; a grey box with twin.linkage must hold"):
        train_twin(loam, load_twin_experiment(None, GROUND), tmp_path / "run", start=tmp_path / "static")
