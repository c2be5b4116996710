"""The C of grey boxes: its tables are those of the Python kernel, its free runs the twin's, its memory its own."""

from __future__ import annotations

import math
import re
from importlib import resources

import numpy as np
import pytest

from edp.data.series import Series
from edp.data.twin_channels import TwinChannels
from edp.errors import ExportError
from edp.export import make_target
from edp.export.c import model
from edp.export.c.parameter_index import index_header
from edp.export.c.sizes import constant_bytes
from edp.export.golden import grown_tolerance, random_inputs, stream
from edp.ir.hydraulics import NONE, HydraulicTick
from edp.networks.twin import TwinPlant, fit_scales
from edp.networks.twin.grey import equations, linkage, parameter_index, tick
from edp.networks.twin.grey.elements import CylinderElement, MotorElement, PumpElement, ValveElement
from edp.networks.twin.greybox import GreyBox
from edp.networks.twin.residual import Residual
from edp.signals import Channel, Kind
from edp.testing.twins import sample_front, sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle

RUNTIME = resources.files("edp.export.c") / "runtime"
C, HEADER, LINKAGE = ((RUNTIME / f"edp_{name}").read_text() for name in ("hydraulics.c", "hydraulics.h", "linkage.c"))
SANITISED = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
SPEC = GreyBox(
    cylinders=(
        CylinderElement(name="ram", velocity="speed", head="head", rod="rod", bore=0.1, rod_diameter=0.06),
        CylinderElement(name="grip", velocity="grip_speed"),
    ),
    valves=(
        ValveElement(name="valve", actuator="ram", extend="up", retract="down", supply="pump"),
        ValveElement(name="second", actuator="ram", extend="grip_lever", supply="second"),
        ValveElement(name="clamp", actuator="grip", extend="grip_lever"),
    ),
    pumps=(PumpElement(name="pump", pressure="line"), PumpElement(name="second")),
    inertia_degree=1,
    potential_degree=3,
)


def bench():
    """Two actuators with two pumps and a supply of constant pressure, one of them without pressures; known numbers."""
    channels = TwinChannels(
        tuple(Channel(name, Kind.RATIO) for name in ("up", "down", "grip_lever")),
        tuple(Channel(name, Kind.VELOCITY) for name in ("speed", "grip_speed")),
        tuple(Channel(name, Kind.POSITION) for name in ("height", "grip_height")),
        tuple(Channel(name, Kind.PRESSURE) for name in ("head", "rod", "line")),
        100.0,
    )
    rng = np.random.default_rng(0)
    levers = np.repeat(rng.uniform(0, 1, (20, 3)), 40, axis=0)
    low = np.array([-0.5, -0.3, 0.0, 0.0, 0.0, 0.0, 1e6])
    high = np.array([0.5, 0.3, 1.0, 0.6, 2e7, 2e7, 2e7])
    series = Series("levers", levers.astype(np.float32), rng.uniform(low, high, (800, 7)).astype(np.float32))
    twin = SPEC.start(channels, fit_scales(channels, [series]), [series], 0)
    table, numbers = twin.table, twin.table.nominal
    for entry, value in ((0, 0.07), (1, 0.01), (2, 0.05)):
        numbers[table.inertia_at + entry * table.inertia_terms] = value
    numbers[table.potential_at : table.potential_at + 2] = 0.01, -0.004
    return plant_bundle(TwinBundle(SPEC, twin.with_parameters(numbers)))


def turning_bench():
    """A ram and a motor that turns without end, whose inertia depends on the ram; one of its ports is not measured."""
    spec = GreyBox(
        cylinders=(CylinderElement(name="ram", velocity="speed"),),
        motors=(MotorElement(name="swing", velocity="turning", a="left", displacement=2e-3),),
        valves=(
            ValveElement(name="valve", actuator="ram", extend="up", retract="down", supply="pump"),
            ValveElement(name="turn", actuator="swing", extend="pedal", supply="pump"),
        ),
        pumps=(PumpElement(name="pump", pressure="line"),),
    )
    channels = TwinChannels(
        tuple(Channel(name, Kind.RATIO) for name in ("up", "down", "pedal")),
        (Channel("speed", Kind.VELOCITY), Channel("turning", Kind.ANGULAR_VELOCITY)),
        (Channel("height", Kind.POSITION), Channel("heading", Kind.ANGLE)),
        tuple(Channel(name, Kind.PRESSURE) for name in ("left", "line")),
        100.0,
    )
    rng = np.random.default_rng(1)
    levers = np.repeat(rng.uniform([0, 0, -1], 1, (20, 3)), 40, axis=0)
    low, high = np.array([-0.5, -1.0, 0.0, -2.0, 0.0, 1e6]), np.array([0.5, 1.0, 1.0, 2.0, 2e7, 2e7])
    series = Series("levers", levers.astype(np.float32), rng.uniform(low, high, (800, 6)).astype(np.float32))
    twin = spec.start(channels, fit_scales(channels, [series]), [series], 0)
    numbers, names = twin.table.nominal, [number.name for number in twin.table.numbers]
    for name, value in (("swing_00", 0.03), ("swing_10", 0.01), ("ram_00", 0.002)):
        numbers[names.index(f"inertia_root_swing_{name}")] = value
    return plant_bundle(TwinBundle(spec, twin.with_parameters(numbers)))


def front_bench():
    """A front whose load is bodies of a known linkage, with opening curves of ten stretches."""
    spec = GreyBox(linkage="m22", curve_segments=10)
    return plant_bundle(TwinBundle(spec, sample_twin(spec, sample_front())[0]))


def test_the_header_of_positions_has_those_that_the_equations_read():
    positions = {name: int(value) for name, value in re.findall(r"\b([A-Z]\w+) = (\d+)", index_header())}
    assert positions == {name: getattr(parameter_index, name) for name in positions}
    read = set(re.findall(r"\b[A-Z][A-Z0-9_]+\b", C + LINKAGE)) & set(vars(parameter_index))
    assert read - set(positions) == {"ATMOSPHERE", "LEAST_ABSOLUTE"}
    assert re.search(r"enum \{ STROKE, (\w+, ){2}\w+ \};", LINKAGE)
    assert parameter_index.KNOT_VALUES == 4


@pytest.mark.parametrize("mixed", [True, False], ids=["mixed", "free"])
def test_c_runs_as_the_twin_with_a_known_linkage(c, mixed, tmp_path):
    bundle = front_bench()
    plant = bundle.predictor
    program = built(c, bundle, tmp_path, "host_test.c", "-O2")
    rows = random_inputs(plant, 600, seed=6, mixed=mixed)
    rows[:, : plant.required] *= 2.0
    expected = stream(plant, rows)
    apart = np.abs(c.stream(program, rows) - expected)
    assert (apart <= grown_tolerance(plant, rows, expected)).all()
    assert (apart[: plant.window] / plant.twin.scales.answer_width).max() < 1e-5
    assert b"all tests passed" in c.run(program)


def test_constants_are_those_of_the_kernel():
    defined = {name: float(value) for name, value in re.findall(r"^#define (\w+) ([0-9.e-]+)", C, re.M)}
    # The Stribeck effect is left out where it is below rounding.
    assert math.exp(-(defined.pop("NEGLIGIBLE") ** 2)) < np.finfo(float).eps
    theirs = dict.fromkeys(("ATMOSPHERE", "LEAST_ABSOLUTE"), parameter_index)
    theirs |= dict.fromkeys(("SMOOTH2", "CHECK", "IDLE", "GAMMA"), equations)
    theirs |= dict.fromkeys(("TOLERANCE", "LARGEST", "STAGE_RATIO"), tick)
    assert float(re.search(r"#define BEYOND ([0-9.]+)", LINKAGE)[1]) == linkage.BEYOND
    assert defined == pytest.approx({name: getattr(room, name) for name, room in theirs.items()}, rel=1e-15)
    assert f"#define EDP_MOST_ITERATIONS {tick.ITERATIONS}u" in HEADER
    assert f"#define EDP_NONE {NONE}u" in HEADER


def built(c, bundle, folder, program, *flags):
    c.need("gcc")
    make_target("c").write(bundle, "predictor", folder)
    c.run("gcc", *c.flags, *flags, "-I", folder, *c.sources(folder), program, "-lm", "-o", "program", folder=folder)
    return folder / "program"


@pytest.mark.parametrize("mixed", [True, False], ids=["mixed", "free"])
def test_c_runs_as_the_twin_with_a_motor(c, mixed, tmp_path):
    bundle = turning_bench()
    plant = bundle.predictor
    program = built(c, bundle, tmp_path, "host_test.c", "-O2")
    rows = random_inputs(plant, 1500, seed=4, mixed=mixed)
    rows[:, 2] += 0.7  # it turns the same way for long: beyond what was seen, where a cylinder would stop
    expected = stream(plant, rows)
    apart = np.abs(c.stream(program, rows) - expected)
    assert (apart <= grown_tolerance(plant, rows, expected)).all()
    assert (apart[: plant.window] / plant.twin.scales.answer_width).max() < 1e-5
    assert mixed or expected[:, 3].max() > 2.0 * 2.0
    assert b"all tests passed" in c.run(program)


@pytest.mark.parametrize("mixed", [True, False], ids=["mixed", "free"])
def test_c_runs_as_the_twin_with_pumps_regeneration_and_ports_that_nobody_measures(c, mixed, tmp_path):
    bundle = bench()
    plant = bundle.predictor
    assert isinstance(plant, TwinPlant)
    program = built(c, bundle, tmp_path, "host_test.c", "-O2")
    rows = random_inputs(plant, 1500, seed=3, mixed=mixed)
    rows[:, : plant.required] *= 3.0  # full levers: checks, reliefs, cushions and end stops act
    expected = stream(plant, rows)
    apart = np.abs(c.stream(program, rows) - expected)
    assert (apart <= grown_tolerance(plant, rows, expected)).all()
    assert (apart[: plant.window] / plant.twin.scales.answer_width).max() < 1e-5
    strokes = expected[:, 2:4]
    assert (strokes == plant.twin.scales.low[2:4]).any() or (strokes == plant.twin.scales.high[2:4]).any()
    assert b"all tests passed" in c.run(program)


def test_a_network_on_a_grey_box_corrects_it_in_c(c, tmp_path):
    spec = Residual(units=5)
    twin, _, _ = sample_twin(spec)
    rng = np.random.default_rng(2)
    for weight in twin.network.parameters():
        weight.data.copy_(weight.data.new_tensor(rng.normal(0, 0.3, tuple(weight.shape))))
    bundle = plant_bundle(TwinBundle(spec, twin))
    program = built(c, bundle, tmp_path, "host_test.c", "-O2")
    rows = random_inputs(bundle.predictor, 400, seed=5)
    expected = stream(bundle.predictor, rows)
    allowed = grown_tolerance(bundle.predictor, rows, expected)
    assert (np.abs(c.stream(program, rows) - expected) <= allowed).all()
    alone = stream(TwinPlant(twin.drop_network(), ""), rows)
    assert (np.abs(alone - expected) > 100 * allowed).any()


def test_sanitisers_and_the_fuzzer_find_nothing(c, tmp_path):
    built(c, bench(), tmp_path, "fuzz.c", "-DREPLAY", *SANITISED)
    (tmp_path / "bytes").write_bytes(np.random.default_rng(0).bytes(4000))
    assert b"every rule held" in c.run(tmp_path / "program", tmp_path / "bytes")


def test_cppcheck_and_clang_object_to_nothing(c, tmp_path):
    c.need("cppcheck", "clang")
    make_target("c").write(bench(), "predictor", tmp_path)
    options = ("--std=c99", "--enable=warning,performance,portability", "--inline-suppr", "--error-exitcode=1", "-q")
    files = ("edp_hydraulics.c", "edp_linkage.c", "predictor.c")
    c.run("cppcheck", *options, "--suppress=missingIncludeSystem", *files, folder=tmp_path)
    c.run("clang", *c.flags, "-O2", "-c", *files, folder=tmp_path)


def test_the_header_says_that_the_time_of_a_tick_varies_and_what_stack_it_takes(tmp_path):
    bundle = bench()
    make_target("c").write(bundle, "predictor", tmp_path)
    layer = next(layer for layer in bundle.predictor.graph().layers if isinstance(layer, HydraulicTick))
    header = (tmp_path / "predictor.h").read_text()
    assert "THE TIME OF A TICK VARIES" in header
    assert f"and {8 * layer.room} bytes of stack" in header
    assert "number of operations is the same" not in header


def test_a_machine_whose_tick_needs_too_large_a_stack_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(model, "MAX_STACK", 1000)
    with pytest.raises(ExportError, match=r"works in [0-9,]+ bytes of stack; at most 1,000.*smaller twin"):
        make_target("c").write(bench(), "predictor", tmp_path / "made")
    assert not (tmp_path / "made").exists()


def test_its_products_are_those_of_an_elimination():
    layer = next(layer for layer in bench().predictor.graph().layers if isinstance(layer, HydraulicTick))
    size, products = layer.unknown, 0
    for k in range(size):
        products += (size - 1 - k) * (size - 1 - k + 1)  # rows below: their rest, and the right side
        products += size - 1 - k  # and once back
    assert layer.macs == 2 * layer.steps * products


def test_its_room_and_its_bytes_are_counted(c, tmp_path):
    bundle = bench()
    graph = bundle.predictor.graph()
    layer = next(layer for layer in graph.layers if isinstance(layer, HydraulicTick))
    # The C code hands out what `room` promises, no more: the last piece ends where the array does.
    taken = re.findall(r"taken\(&room, ([^;]+)\);", C)
    n, valves, pumps = layer.sizes
    sizes = {"r->unknown": layer.unknown, "r->all": layer.unknown - n + 2, "n": n, "h->terms": len(layer.exponents)}
    sizes |= {"h->powers": layer.powers, "h->valves": valves, "VALVE_STATES": 5, "h->pumps": pumps, "2u": 2}
    total = sum(int(np.prod([sizes[factor] for factor in text.split(" * ")])) for text in taken)
    assert total == layer.room
    c.need("arm-none-eabi-gcc")
    make_target("c").write(bundle, "predictor", tmp_path)
    arm = ("-mthumb", "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-O2", "-fdata-sections")
    c.run("arm-none-eabi-gcc", *c.flags, *arm, "-c", "predictor.c", folder=tmp_path)
    listed = c.run("arm-none-eabi-readelf", "-SW", "predictor.o", folder=tmp_path).decode()
    held = re.findall(r"^\s*\[\s*\d+\]\s+\.rodata\S*\s+PROGBITS\s+\S+\s+\S+\s+([0-9a-f]+)", listed, re.M)
    assert sum(-(-int(size, 16) // 4) * 4 for size in held) == constant_bytes(graph)
