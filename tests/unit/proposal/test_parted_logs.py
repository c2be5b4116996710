"""Experiments beside each other in a MAT file, and logs of which each moves a part of the machine."""

from __future__ import annotations

import tomllib

import numpy as np
import pytest
import scipy.io

from edp.errors import DataError
from edp.logs import open_log, read_recording
from edp.logs.formats.matlab.library import MatlabOpaque, matio
from edp.logs.source import DataSource
from edp.signals import SignalMap
from edp.workflows.proposal import propose, write_proposal

pytestmark = pytest.mark.processes

ALL = SignalMap(others=True)


def experiment(seed: int, rows: int = 400, **more: object) -> dict[str, object]:
    """A valve's opening in steps and the pressure that follows it, at 20 Hz."""
    rng = np.random.default_rng(seed)
    u = np.repeat(rng.standard_normal((rows // 20 + 1, 2)), 20, axis=0)[:rows]
    y = np.cumsum(u @ [[1.0, 0.2], [0.1, 1.0]], axis=0) / 20 + 0.01 * rng.standard_normal((rows, 2))
    return {"t": np.arange(rows).reshape(-1, 1) / 20, "y": y, "u": u} | more


def cell(*elements: object) -> np.ndarray:
    held = np.empty((1, len(elements)), dtype=object)
    for i, element in enumerate(elements):
        held[0, i] = element
    return held


@pytest.fixture
def arm(tmp_path):
    path = tmp_path / "arm.mat"
    train = cell(*(experiment(i, 400 + 10 * i) for i in range(5)))
    scipy.io.savemat(path, {"train": train, "val": cell(experiment(7), experiment(8)), "gain": 2.0})
    return path


def test_cells_of_structs_become_a_recording_each_and_those_named_val_test(arm, tmp_path):
    proposal = propose(arm)
    assert proposal.targets == ("y_1", "y_2")
    assert {guess.column for guess in proposal.proposal.select_role("command")} == {"u_1", "u_2"}
    assert any("7 experiments" in note and "2 test" in note for note in proposal.notes)
    write_proposal(proposal, tmp_path / "out")
    data = DataSource.from_path(tmp_path / "out" / "data.toml")
    recordings = data.read()
    assert [recording.name for recording in recordings] == [*(f"train_{i + 1}" for i in range(5)), "val_1", "val_2"]
    assert [recording.samples for recording in recordings] == [400, 410, 420, 430, 440, 400, 400]
    assert tomllib.loads(proposal.files["settings.toml"])["split"] == {"kind": "recordings", "test": ["val_1", "val_2"]}
    np.testing.assert_allclose(recordings[6].column("y_2"), experiment(8)["y"][:, 1], rtol=1e-6)


def test_one_experiment_is_named_as_matlab_takes_it_out(arm):
    made = read_recording(arm, SignalMap(others=True, variable="train{3}"))
    assert made.samples == 420
    np.testing.assert_allclose(made.column("u_1"), experiment(2, 420)["u"][:, 0], rtol=1e-6)
    assert open_log(arm, ALL).meta["experiments"][4:6] == ["train{5}", "val{1}"]


@pytest.mark.parametrize(
    "name", ["train{6}", "train{0}", "train{-1}", "train{1}{1}", "gain{1}", "{1}", "train{99999999999}", "../val{1}"]
)
def test_an_experiment_that_is_not_there_is_one_error(arm, name):
    with pytest.raises(DataError, match=r"has no variable .*(train|val)\{\d\}.*existing one"):
        read_recording(arm, SignalMap(others=True, variable=name))


def test_a_struct_array_is_parted_and_one_of_channels_is_not(tmp_path):
    kind = [("t", object), ("y", object), ("u", object)]
    runs = np.empty((1, 3), dtype=kind)
    for i in range(3):
        runs[0, i] = tuple(experiment(i).values())
    scipy.io.savemat(tmp_path / "runs.mat", {"runs": runs})
    assert open_log(tmp_path / "runs.mat", ALL).meta["experiments"] == ["runs{1}", "runs{2}", "runs{3}"]
    assert read_recording(tmp_path / "runs.mat", SignalMap(others=True, variable="runs{2}")).samples == 400
    # A capture of dSPACE has an element a channel, with one vector each.
    channels = cell(*({"Name": f"c{i}", "Data": np.arange(50.0)} for i in range(3)))
    scipy.io.savemat(tmp_path / "capture.mat", {"Y": channels})
    assert "experiments" not in open_log(tmp_path / "capture.mat", ALL).meta


@pytest.mark.parametrize(
    "odd",
    [
        cell(experiment(0), "words"),  # what is not alike is no set of experiments
        cell(experiment(0), {"t": np.arange(400.0), "z": np.arange(400.0)}),
        cell(experiment(0), experiment(1, rows=3)),
        cell(experiment(0)),
    ],
)
def test_what_is_not_alike_is_read_as_before(tmp_path, odd):
    scipy.io.savemat(tmp_path / "odd.mat", {"odd": odd})
    assert "experiments" not in open_log(tmp_path / "odd.mat", ALL).meta


def test_iddata_of_several_experiments_is_read_one_by_one(tmp_path):
    inputs, outputs = cell(np.ones((50, 2)), np.zeros((60, 2))), cell(np.ones((50, 2)), np.full((60, 2), 5.0))
    data = {"InputData": inputs, "OutputData": outputs, "Ts": cell(0.1, 0.05)}
    # Names of two channels are no cell of two experiments.
    names = {"InputName_": cell("valve", "pump"), "OutputName_": cell("p", "q"), "TimeUnit_": np.array(["seconds"])}
    both = MatlabOpaque(names | {"Data_": MatlabOpaque(data, "idpack.iodata.TimeIOData")}, "iddata")
    matio.save_to_mat(str(tmp_path / "z.mat"), {"z": both})
    with pytest.raises(DataError, match=r'2 experiments.*variable = "z\{1\}"'):
        read_recording(tmp_path / "z.mat", ALL)
    second = read_recording(tmp_path / "z.mat", SignalMap(others=True, variable="z{2}"))
    assert (second.samples, second.channel_names) == (60, ("valve", "pump", "p", "q"))
    assert second.rate_hz == pytest.approx(20.0)


def one_axis(seed: int, axis: int, rows: int = 400) -> str:
    rng = np.random.default_rng(seed)
    lever = np.zeros((rows, 2))
    lever[:, axis] = np.repeat(rng.standard_normal(rows // 20), 20)
    angle = np.cumsum(lever, axis=0) / 10 + 1e-3 * rng.standard_normal((rows, 2))
    table = np.column_stack([np.arange(rows) / 20, lever, angle])
    return "\n".join(["time,cmd_1,cmd_2,angle_1,angle_2", *(",".join(f"{x:.4f}" for x in row) for row in table)])


@pytest.mark.parametrize(("axes", "kind"), [([0, 0, 0, 0, 1, 1], "time"), ([0] * 6, "names")])
def test_where_each_log_moves_one_axis_the_end_of_each_log_tests(tmp_path, axes, kind):
    for i, axis in enumerate(axes):
        (tmp_path / f"run_{i}.csv").write_text(one_axis(i, axis))
    proposal = propose(tmp_path)
    split = tomllib.loads(proposal.files["settings.toml"])["split"]
    assert split["kind"] in ({"time", "blocks"} if kind == "time" else {kind})
    told = [note for note in proposal.notes if "the end of each log tests" in note]
    assert bool(told) == (kind == "time")
