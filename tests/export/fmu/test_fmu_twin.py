"""An FMU of a twin is a plant: commands in, states out, and it goes back to a saved state."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest

from edp.export.fmu.target import FmuTarget
from edp.export.golden import grown_tolerance, random_inputs, stream
from edp.networks.twin.recurrent import Recurrent
from edp.testing.twins import sample_twin
from edp.training.twin_bundle import TwinBundle, plant_bundle

pytest.importorskip("fmpy")
BUILD = ("-std=c99", "-O1", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared")


@pytest.fixture(scope="module")
def bundle():
    spec = Recurrent(units=5)
    return plant_bundle(TwinBundle(spec, sample_twin(spec)[0]))


@pytest.fixture(scope="module", params=[2, 3])
def made(request, c, fmi, bundle, tmp_path_factory):
    c.need("gcc")
    folder, version = tmp_path_factory.mktemp("twin"), request.param
    FmuTarget(version=str(version), binaries="none").write(bundle, "predictor", folder)
    with zipfile.ZipFile(folder / f"predictor_fmi{version}.fmu") as archive:
        archive.extractall(folder)
    target = folder / "binaries" / fmi.folders[version]
    target.mkdir(parents=True)
    listed = fmi.sources(folder, version)
    c.run("gcc", *BUILD, *listed, "-lm", "-o", target / "predictor.so", folder=folder / "sources")
    return fmi.Unit(folder, version).start()


def test_a_plant_runs_on_its_commands_alone_and_goes_back_to_a_saved_state(made, bundle):
    plant = bundle.predictor
    rows = random_inputs(plant, plant.window + 60, seed=8, mixed=False)
    expected = stream(plant, rows)
    allowed = grown_tolerance(plant, rows, expected)
    measured = made.stream(rows[: plant.window])
    assert (np.abs(measured - expected[: plant.window]) <= allowed[: plant.window]).all()
    kept = made.fmu.getFMUState()
    flags = made.inputs[-plant.sizes[2] :]
    made.set(np.zeros(len(flags)), flags)
    runs = []
    for _ in range(2):
        made.fmu.setFMUState(kept)
        made.set(np.zeros(len(flags)), flags)
        made.tick = plant.window
        free = []
        for row in rows[plant.window :]:
            made.set(row[: plant.required], made.inputs[: plant.required])
            assert made.go() == 0
            free.append(made.get(made.outputs))
        runs.append(np.array(free, dtype=np.float32))
    assert np.array_equal(runs[0], runs[1])
    assert (np.abs(runs[0] - expected[plant.window :]) <= allowed[plant.window :]).all()
    assert made.valid


def test_measured_values_that_were_never_set_leave_their_ports_free(made, bundle, fmi):
    other = fmi.Unit(made.folder, made.version).start()
    plant = bundle.predictor
    other.set(np.zeros(plant.required), other.inputs[: plant.required])
    assert other.go() == 0
    assert other.whole("status") == 1
    # A command has no other source.
    unset = fmi.Unit(made.folder, made.version).start()
    unset.go()
    assert unset.whole("status") == 3
    assert any("was never set" in text for _, text in unset.told)
