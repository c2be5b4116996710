"""Software in the loop: the exported controller grades a line on the exported twin, an FMU that FMPy steps."""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from exported_controllers import Compiled

from edp.control.tasks import draw_task
from edp.export.fmu.target import FmuTarget
from edp.training.twin_bundle import plant_bundle
from edp.workflows.control.kept import load_kept

pytest.importorskip("fmpy")
BUILD = ("-std=c99", "-O1", "-ffp-contract=off", "-fvisibility=hidden", "-fPIC", "-shared")


class FmuPlant:
    """An FMU of a twin as a plant: levers become pilot pressures, and the observation is what the plant shows."""

    def __init__(self, unit, kept):
        self.unit, self.kept = unit, kept
        self.channels = kept.twin.twin.channels
        self.answers = [channel.name for channel in self.channels.answers]
        self.commands = [channel.name for channel in self.channels.commands]
        pilots = [channel.name for channel in kept.plant.command_channels]
        self.pilots = [pilots.index(name) for name in self.commands]

    def rest(self, observed):
        """Form its memory in a measured prefix: the machine at rest, as the first observation shows it."""
        names = [channel.name for channel in self.kept.plant.channels]
        means = self.kept.twin.twin.scales.answer_offset
        # What the machine does not measure, such as pump pressures, is at its mean.
        measured = [observed[names.index(n)] if n in names else m for n, m in zip(self.answers, means, strict=True)]
        row = np.concatenate([self._pressures(np.zeros(3)), measured, np.ones(len(measured))])
        for _ in range(self.kept.twin.twin.prefix_ticks):
            self.unit.set(row)
            assert self.unit.go() == 0
        self.unit.set(np.zeros(len(measured)), self.unit.inputs[-len(measured) :])
        return self._shown(np.zeros(3))

    def step(self, levers):
        """A tick on commands alone."""
        self.unit.set(self._pressures(levers), self.unit.inputs[: len(self.commands)])
        assert self.unit.go() == 0
        return self._shown(levers)

    def _pressures(self, levers):
        return self.kept.plant.commands(levers)[self.pilots]

    def _shown(self, levers):
        names = [channel.name for channel in self.kept.plant.channels]
        row = np.full(len(names), np.nan)
        for name, value in zip(self.answers, self.unit.get(self.unit.outputs), strict=True):
            if name in names:
                row[names.index(name)] = value
        return row


@pytest.fixture(scope="module", params=[("exported_plan", 2), ("exported_plan", 3), ("exported_grey", 3)])
def case(request):
    """A controller on a recurrent twin or on a grey box, and the version of FMI in which its twin is the plant."""
    kind, version = request.param
    exported = request.getfixturevalue(kind)
    return exported, load_kept(exported.run), version


@pytest.fixture(scope="module")
def plant(case, c, fmi, tmp_path_factory):
    _, kept, version = case
    folder = tmp_path_factory.mktemp("plant")
    FmuTarget(version=str(version), binaries="none").write(plant_bundle(kept.twin), "plant", folder)
    with zipfile.ZipFile(folder / f"plant_fmi{version}.fmu") as archive:
        archive.extractall(folder)
    target = folder / "binaries" / fmi.folders[version]
    target.mkdir(parents=True)
    listed = fmi.sources(folder, version)
    c.run("gcc", *BUILD, *listed, "-lm", "-o", target / "plant.so", folder=folder / "sources")
    return FmuPlant(fmi.Unit(folder, version).start(), kept)


def test_the_compiled_controller_grades_a_line_on_the_exported_twin(case, plant):
    exported, kept, _ = case
    python = kept.experiment.controller.build(kept.plant, kept.experiment.task.limits, kept.models)
    controller = Compiled(exported.library, kept.plant, python.reads)
    # The line of the run, whose start is the first kept observation.
    task = draw_task(kept.experiment.task, kept.plant.geometry, kept.plant.rate_hz, kept.experiment.seed)
    reference = task.reference
    observed = plant.rest(kept.observed[0])
    assert controller.reset(observed, reference) == 0
    strokes = []
    columns = kept.plant.columns(("CylStroke_1", "CylStroke_2", "CylStroke_3"))
    for tick in range(reference.ticks):
        strokes.append(observed[columns])
        observed = plant.step(controller.step(observed, tick))
    tip = kept.plant.geometry.tip(np.array(strokes))
    off = np.hypot(*(tip - reference.tip)[:, :2].T)[reference.judged]
    way = np.hypot(*(reference.tip[-1] - reference.tip[0])[:2])
    assert way > 0.35
    # The plant is the controller's own model: what is left is its plan, not its knowledge.
    assert np.sqrt((off**2).mean()) < 0.01
    assert set(controller.statuses) == {0}
