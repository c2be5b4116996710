"""An FMU is a plant in closed loop: ours gives the loops of its twin, and one of another tool runs by its names."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest

from edp.config.control import ControlExperiment
from edp.control.controllers import CONTROLLERS
from edp.control.fmu.environment import FmuEnvironment
from edp.control.learning import TaskEnvironment
from edp.control.plant import PILOTS, STROKES
from edp.control.plants import plant_of
from edp.control.tasks import TASKS
from edp.control.twin_environment import TwinEnvironment
from edp.control.valve_map import ValveMap
from edp.errors import ConfigError, DataError
from edp.export.fmu.target import FmuTarget
from edp.networks.twin import TWINS
from edp.sim.excitation.levers import speed_table
from edp.sim.machine.machine_files import load_machine
from edp.sim.scenario import SimulationError
from edp.testing.control import sample_excavator_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle, save_twin
from edp.workflows.control import ControlBench, ControlSources, TuningSpec, tune_gains

fmpy = pytest.importorskip("fmpy")
BUILD = ("-std=c99", "-O1", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared")
LINE = {"length_m": (0.4, 0.5), "hold_s": 0.2, "lead_s": 0.2}
TOLERANCE_MM = 0.01
"""Between position errors of a loop on a twin and on its FMU."""


def packed(folder, file):
    with zipfile.ZipFile(file, "w") as archive:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path != file:
                archive.write(path, path.relative_to(folder).as_posix())
    return file


@pytest.fixture(scope="module")
def twin():
    return sample_excavator_twin()


@pytest.fixture(scope="module")
def twin_run(twin, tmp_path_factory):
    run = tmp_path_factory.mktemp("twins") / "run"
    save_twin(TwinBundle(TWINS["static"](), twin), run / "twin")
    return run


@pytest.fixture(scope="module", params=[2, 3])
def fmu(request, c, fmi, twin, tmp_path_factory):
    """An exported twin with a library that the compiler of the system built."""
    c.need("gcc")
    version, folder = request.param, tmp_path_factory.mktemp("fmu")
    bundle = plant_bundle(TwinBundle(TWINS["static"](), twin))
    FmuTarget(version=str(version), binaries="none", derivatives=False).write(bundle, "predictor", folder)
    source = folder / "unpacked"
    with zipfile.ZipFile(folder / f"predictor_fmi{version}.fmu") as archive:
        archive.extractall(source)
    target = source / "binaries" / fmi.folders[version]
    target.mkdir(parents=True)
    listed = fmi.sources(source, version)
    c.run("gcc", *BUILD, *listed, "-lm", "-o", target / "predictor.so", folder=source / "sources")
    return packed(source, folder / "twin.fmu")


def described(change=lambda text: text):
    inputs = [
        f'<ScalarVariable name="{name}" valueReference="{n}" causality="input"><Real unit="N/m2"/></ScalarVariable>'
        for n, name in enumerate(PILOTS[:6])
    ]
    starts = [
        f'<ScalarVariable name="{name}_start" valueReference="{6 + n}" causality="parameter">'
        '<Real declaredType="Way" start="0"/></ScalarVariable>'
        for n, name in enumerate(STROKES)
    ]
    outputs = [
        f'<ScalarVariable name="{kind}_{n + 1}" valueReference="{at + n}" causality="output"><Real/></ScalarVariable>'
        for kind, at in (("CylVels", 10), ("CylStroke", 13))
        for n in range(3)
    ]
    return change(
        '<fmiModelDescription fmiVersion="2.0" guid="{plant}" modelName="plant">'
        '<CoSimulation modelIdentifier="plant"/>'
        '<UnitDefinitions><Unit name="N/m2"><BaseUnit kg="1" m="-1" s="-2"/></Unit></UnitDefinitions>'
        '<TypeDefinitions><SimpleType name="Way"><Real unit="m"/></SimpleType></TypeDefinitions>'
        f'<DefaultExperiment stepSize="0.01"/><ModelVariables>{"".join(inputs + starts + outputs)}</ModelVariables>'
        "</fmiModelDescription>"
    )


@pytest.fixture(scope="module")
def stranger(c, fmi, tmp_path_factory):
    """Builds the unit of another tool, whose description may be changed."""
    c.need("gcc")

    def build(change=lambda text: text, breaks=0, refuses=0):
        from fmpy import fmi2

        folder = tmp_path_factory.mktemp("stranger")
        source = folder / "plant.c"
        written = (Path(__file__).parent / "plant.c").read_text()
        names = [name for name in dir(fmi2.FMU2Slave) if name.startswith("fmi2") and name not in written]
        # FMPy looks for every function of the standard.
        source.write_text(written + "".join(f"EXPORT int {name}(void) {{ return 3; }}\n" for name in names))
        target = folder / "unpacked" / "binaries" / fmi.folders[2]
        target.mkdir(parents=True)
        flags = (f"-DBREAKS_AFTER={breaks}", f"-DREFUSES_AFTER={refuses}")
        c.run("gcc", *BUILD, *flags, source, "-lm", "-o", target / "plant.so", folder=folder)
        (folder / "unpacked" / "modelDescription.xml").write_text(described(change))
        return packed(folder / "unpacked", folder / "plant.fmu")

    return build


def test_an_fmu_of_a_twin_gives_its_observations(twin, fmu):
    plants = TwinEnvironment(twin, "M22", 20.0), plant_of("M22", 20.0, 100.0, fmu, trusted=True)
    assert plants[0].channels == plants[1].channels
    rng = np.random.default_rng(0)
    # Twice: the second episode begins as a new one would.
    for shares in ((0.4, 0.6, 0.3), (0.5, 0.5, 0.5)):
        rows = [env.reset(options={"strokes": shares})[0] for env in plants]
        assert np.array_equal(*rows)
        for _ in range(8):
            levers = rng.uniform(-0.6, 0.6, 3)
            for _ in range(40):
                rows = [env.step(levers)[0] for env in plants]
            assert rows[1] == pytest.approx(rows[0], rel=1e-4, abs=1e-5)
    plants[1].close()
    plants[1].close()
    with pytest.raises(ConfigError, match="call reset"):
        plants[1].step(np.zeros(3))


def test_loops_and_tunings_on_an_fmu_are_those_on_its_twin(fmu, twin_run, tmp_path, monkeypatch):
    # Measuring the map takes ten thousand ticks on each plant; that they answer alike is tested above.
    valves = ValveMap(*speed_table(load_machine("M22")))
    monkeypatch.setattr("edp.workflows.control.bench.measure_valve_map", lambda *_: valves)
    experiment = ControlExperiment(task=TASKS["grade"](**LINE), controller=CONTROLLERS["pi"](), loops=2)
    plants = ControlSources(plant=twin_run), ControlSources(plant=fmu, trusted=True)
    benches = [ControlBench(experiment, plant) for plant in plants]
    for one, other in zip(*(bench.results() for bench in benches), strict=True):
        assert other.score.position_rms_mm == pytest.approx(one.score.position_rms_mm, abs=TOLERANCE_MM)
        assert other.score.path_rms_mm == pytest.approx(one.score.path_rms_mm, abs=TOLERANCE_MM)
        assert other.score.violations == one.score.violations
    spec = TuningSpec(trials=2, loops=1)
    contents = [tune_gains(experiment, tmp_path / str(n), plant, plant, spec).content for n, plant in enumerate(plants)]
    costs = [[trial.cost_mm for trial in content.trials] for content in contents]
    assert costs[1] == pytest.approx(costs[0], abs=TOLERANCE_MM)
    assert contents[1].judged_mm.after == pytest.approx(contents[0].judged_mm.after, abs=TOLERANCE_MM)


def test_a_task_is_learned_on_an_fmu_too(fmu):
    changes = {"options": LINE, "hold": 5, "duration_s": 4.0}
    with pytest.raises(ConfigError, match="native code"):
        TaskEnvironment(plant=str(fmu), **changes)
    env = TaskEnvironment(plant=str(fmu), trust_fmu=True, **changes)
    first, _ = env.reset(seed=3)
    env.step(np.array([0.3, 0.0, 0.0]))
    assert np.array_equal(env.reset(seed=3)[0], first)


def test_an_fmu_of_another_tool_runs_by_its_names_and_starts_by_its_parameters(stranger):
    env = FmuEnvironment(stranger(), "M22", 5.0, 100.0)
    assert [channel.name for channel in env.channels] == [
        *(f"CylVels_{n}" for n in (1, 2, 3)), *STROKES, *PILOTS[:6],
    ]  # fmt: skip
    full = np.array(env.machine.cylinders.stroke)
    row, info = env.reset(options={"strokes": (0.2, 0.5, 0.8)})
    assert row[3:6] == pytest.approx(full * [0.2, 0.5, 0.8], rel=1e-6)
    levers = np.array([0.5, -0.25, 0.0])
    pilots = env.commands(levers)[:6]
    for _ in range(10):
        row, _, _, truncated, info = env.step(levers)
    velocity = 1e-7 * (pilots[::2] - pilots[1::2])
    assert row[:3] == pytest.approx(velocity, rel=1e-6)
    assert info["truth"]["CylStroke_1"] == pytest.approx(0.2 * full[0] + 0.1 * velocity[0], rel=1e-6)
    assert row[6:] == pytest.approx(pilots)
    assert not truncated


def test_without_parameters_it_must_begin_where_it_is_asked(stranger):
    env = FmuEnvironment(stranger(lambda text: text.replace("_start", "_begin")), "M22", 5.0, 100.0)
    with pytest.raises(ConfigError, match=r"begins with CylStroke_\d at 0.000 m, the task at .* CylStroke_1_start"):
        env.reset(options={"strokes": (0.2, 0.5, 0.8)})
    assert env.reset(options={"strokes": (0.0, 0.01, 0.0)})[0][3:6] == pytest.approx(0.0)


def test_what_is_no_longer_finite_is_an_error_with_its_channel_and_tick(stranger):
    env = FmuEnvironment(stranger(breaks=3), "M22", 5.0, 100.0)
    env.reset()
    env.step(np.zeros(3))
    env.step(np.zeros(3))
    with pytest.raises(SimulationError, match="answers 'CylVels_2' = nan after 3 ticks"):
        env.step(np.zeros(3))


def test_a_refused_step_is_one_error(stranger):
    env = FmuEnvironment(stranger(refuses=2), "M22", 5.0, 100.0)
    env.reset()
    env.step(np.zeros(3))
    with pytest.raises(SimulationError, match=r"refuses doStep: .*\(error\)"):
        env.step(np.zeros(3))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda text: text.replace("{plant}", "{other}"), "cannot be instantiated"),
        (lambda text: text.replace('m="-1" s="-2"', 'm="-1" s="-2" factor="100000"'), "is in N/m2; expected Pa"),
        (lambda text: text.replace('<Real unit="m"/>', '<Real unit="mm"/>'), "is in mm; expected m"),
    ],
)
def test_what_does_not_fit_is_refused_before_a_loop(stranger, change, message):
    with pytest.raises(DataError, match=message):
        FmuEnvironment(stranger(change), "M22", 5.0, 100.0)


def test_options_and_levers_that_are_none_are_refused(stranger):
    env = FmuEnvironment(stranger(), "M22", 5.0, 100.0)
    with pytest.raises(ConfigError, match="call reset"):
        env.step(np.zeros(3))
    with pytest.raises(ConfigError, match="option 'stroke' is unknown; did you mean 'strokes'"):
        env.reset(options={"stroke": 1})
    with pytest.raises(ConfigError, match="an FMU knows no soil"):
        env.reset(options={"material": "clay"})
    env.reset()
    with pytest.raises(ConfigError, match="three finite"):
        env.step(np.array([0.0, np.nan, 0.0]))
