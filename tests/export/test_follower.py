"""The follower in C: the ticks of the Python package, faults and gaps, learning by pieces, its rules, its size."""

from __future__ import annotations

import re

import numpy as np
import pytest

from edp.errors import ConfigError, ExportError
from edp.export.follower import FollowerParts, write_follower
from edp.networks.twin import fit_scales
from edp.networks.twin.adaptive_twin import TunedSpec
from edp.testing.bench import bench_channels, bench_grey_box, bench_series
from edp.training.twin_bundle import TwinBundle, plant_bundle

BENCH = bench_grey_box()
HORIZONS, LIMIT = (3, 8), np.array([[0.05], [0.1]])
NAME = "follower"


@pytest.fixture(scope="module")
def bench():
    """A grey box of a cylinder, levers, and the answers of a machine with dead bands half as wide again."""
    channels = bench_channels(description="*/ int y; /*")
    series = [bench_series(2000, seed) for seed in range(2)]
    twin = BENCH.start(channels, fit_scales(channels, series), series, 0)
    numbers = twin.table.nominal
    numbers[twin.table.inertia_at], numbers[twin.table.potential_at] = 0.07, 0.01  # 4.9 t, 20 kN
    twin, levers = twin.with_parameters(numbers), series[0].inputs
    bands = [number.name.startswith("dead_band") for number in twin.table.numbers]
    worn = twin.with_parameters(np.where(bands, 1.5, 1.0) * twin.numbers)
    start = np.array([[0.0, 0.5, 5e6, 5e6, 5e6]], np.float32)
    answers, _ = worn.rollout(levers[None, :-1], worn.initial_state(levers[None, 0], start))
    return twin, levers, np.concatenate([start, answers[0]])


def parts_of(twin, **options):
    return FollowerParts("a follower", twin, TunedSpec(**options), ("speed",), HORIZONS, LIMIT)


@pytest.fixture(scope="module")
def program(c, bench, tmp_path_factory):
    """The self-test of a follower; the equations are compiled once, its own files for each set of flags."""
    made, equations = {}, []

    def make(*flags, **options):
        c.need("gcc")
        key = (flags, tuple(options.items()))
        if key in made:
            return made[key] / "program"
        folder, twin = tmp_path_factory.mktemp("follower"), bench[0]
        write_follower(parts_of(twin, **options), plant_bundle(TwinBundle(twin.spec, twin)), NAME, folder)
        sources = sources_of(folder)
        own = [name for name in sources if name.startswith((NAME, "edp_follow"))]
        if not equations:
            rest = [name for name in sources if name not in own]
            c.run("gcc", *c.flags, "-O1", "-I.", "-c", *rest, folder=folder)
            equations.extend(folder / name.replace(".c", ".o") for name in rest)
        c.run("gcc", *c.flags, *flags, "-I.", *own, "host_test.c", *equations, "-lm", "-o", "program", folder=folder)
        made[key] = folder
        return folder / "program"

    return make


def sources_of(folder):
    """C files that a program with the follower compiles, as its CMake file says."""
    return re.search(r"STATIC (.*)\)", (folder / "CMakeLists.txt").read_text())[1].split()


def streamed(c, program, runs, levers, measured, oil, predictions):
    """Moved predictions, forecasts, factors and status of each tick."""
    rows = np.concatenate([levers, measured, oil[:, None], predictions.reshape(len(levers), -1)], axis=1)
    found = c.run(program, "stream", str(runs), feed=np.ascontiguousarray(rows, np.float32).tobytes())
    numbers = np.frombuffer(found, np.float32).reshape(len(levers), -1)
    return np.split(numbers, np.cumsum([2, 2, numbers.shape[1] - 5]), axis=1)


def in_python(parts, levers, measured, oil, predictions):
    correction = parts.correction()
    moved, forecasts, factors = [], [], []
    for row in zip(levers, measured, predictions, oil, strict=True):
        moved.append(correction.step(*row[:3], float(row[3])).ravel())
        said = [correction.tuned.forecast(k) for k in HORIZONS]
        forecasts.append([np.nan if one is None else one[0] for one in said])
        factors.append(list(correction.tuned.factors.values()))
    return np.array(moved), np.array(forecasts), np.array(factors)


def hard(levers, measured):
    """Noise, missing sensors and commands, a broken thermometer, predictions that lag and one that is missing."""
    rng = np.random.default_rng(3)
    levers, measured = levers.copy(), measured + rng.normal(0, [2e-3, 1e-4, 1e4, 1e4, 1e4], measured.shape)
    measured[300:310, 0], measured[400, 2:4], levers[700] = np.nan, np.nan, np.nan
    oil = np.full(len(levers), np.nan)
    oil[900:], oil[950] = 40.0, 4000.0
    predictions = np.repeat(measured[:, None, :1], 2, axis=1)
    predictions[1500] = np.nan
    return (levers, *(rows.astype(np.float32) for rows in (measured, oil, predictions)))


def test_each_tick_is_that_of_python_through_faults_and_gaps(c, bench, program):
    twin, levers, measured = bench
    rows, parts = hard(levers, measured), parts_of(twin, oil_c=30.0)
    moved, forecasts, factors, status = streamed(c, program("-O1", oil_c=30.0), 100, *rows)
    wanted = in_python(parts, *rows)
    np.testing.assert_array_equal(np.isnan(forecasts), np.isnan(wanted[1]))
    np.testing.assert_allclose(factors, wanted[2], rtol=5e-3)
    np.testing.assert_allclose(forecasts, wanted[1], atol=5e-4)
    np.testing.assert_allclose(moved, wanted[0], atol=5e-4)
    assert np.nanmax(np.abs(moved - rows[3][:, :, 0])) > 0.01  # there is something to move
    assert set(status[:, 0]) == {1, 2, 3}


def test_learning_by_pieces_finds_the_dead_band_as_learning_at_once(c, bench, program):
    _, levers, measured = bench
    oil, zero = np.full(len(levers), np.nan, np.float32), np.zeros((len(levers), 2), np.float32)
    made = program("-O1", groups=("dead_band",), load_share=0.0)
    found = {runs: streamed(c, made, runs, levers, measured, oil, zero)[2] for runs in (0, 1, 100)}
    assert (found[0] == 1.0).all()
    assert found[100][-1, 0] == pytest.approx(1.5, rel=0.05)
    np.testing.assert_allclose(found[1][200:], found[100][200:], rtol=0.05)
    # A stretch teaches a tick later when its two runs are a tick apart.
    assert np.flatnonzero(found[1] != 1.0)[0] == np.flatnonzero(found[100] != 1.0)[0] + 1


def test_its_self_test_passes_under_sanitisers(c, program):
    made = program("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
    told = c.run(made).decode()
    assert "all tests passed" in told
    assert float(re.search(r"of a factor: (\S+)", told)[1]) < 1e-2


def test_it_asks_nothing_of_the_heap_and_its_size_is_what_the_header_says(c, bench, program, tmp_path):
    folder = program("-O1").parent
    c.need("arm-none-eabi-gcc")
    m7 = ("-mthumb", "-mcpu=cortex-m7", "-mfloat-abi=hard", "-mfpu=fpv5-d16", "-O1")
    sources = [folder / "edp_follow.c", folder / f"{NAME}.c"]
    for source in sources:
        c.run("arm-none-eabi-gcc", *c.flags, *m7, "-I", folder, "-c", source, folder=tmp_path)
    wanted = {word for path in tmp_path.glob("*.o") for word in undefined(c, path)}
    assert not wanted & {"malloc", "calloc", "realloc", "free"}
    (tmp_path / "size.c").write_text(f'#include "{NAME}.h"\nchar state[sizeof({NAME}_state)];\n')
    c.run("arm-none-eabi-gcc", *m7, "-I", folder, "-c", "size.c", folder=tmp_path)
    told = c.run("arm-none-eabi-size", "size.o", folder=tmp_path).decode().splitlines()[1].split()
    said = int(re.search(r"state about (\d+) bytes", (folder / f"{NAME}.h").read_text())[1])
    assert int(told[2]) == pytest.approx(said, rel=0.02)


def undefined(c, path):
    lines = c.run("arm-none-eabi-nm", "-u", path).decode().splitlines()
    return [line.split()[-1] for line in lines if line.strip()]


@pytest.mark.slow
def test_its_cmake_file_builds_it(c, program):
    c.need("cmake", "gcc")
    folder = program("-O1").parent
    c.run("cmake", "-S", folder, "-B", folder / "build")
    c.run("cmake", "--build", folder / "build")


def test_what_cannot_be_written_is_refused(bench, tmp_path):
    twin = bench[0]
    plant = plant_bundle(TwinBundle(twin.spec, twin))
    with pytest.raises(ExportError, match="at most 20 must hold"):
        write_follower(parts_of(twin), plant, "n" * 21, tmp_path)
    with pytest.raises(ExportError, match="prefix of C functions"):
        write_follower(parts_of(twin), plant, "../x", tmp_path)
    other = FollowerParts("x", twin, TunedSpec(), ("swing",), HORIZONS, LIMIT)
    with pytest.raises(ConfigError, match="'swing' is predicted, but no velocity"):
        write_follower(other, plant, NAME, tmp_path)
    with pytest.raises(ConfigError, match="unknown group of numbers 'lag'"):
        write_follower(parts_of(twin, groups=("lag",)), plant, NAME, tmp_path)
    assert not list(tmp_path.iterdir())
