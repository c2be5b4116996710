"""Proposals for measured logs of other people, against tables made by hand from what their authors say of them."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from edp.logs.proposal.kinds import BOUND
from edp.workflows.proposal import propose
from edp.workflows.proposal.files import MAP, SETTINGS

ROOT = Path(os.environ.get("EDP_SHARED_DATA") or Path(__file__).parents[3].parent / "shared" / "data")
pytestmark = [pytest.mark.processes, pytest.mark.shared_data]

NUMBERS = ("generic", "1")
BAR, CELSIUS, FLOW, SHARE = ("pressure", "bar"), ("temperature", "degC"), ("flow", "L/min"), ("ratio", "%")
INPUT, TIME, OUTPUT = {"command", "reference"}, {"time"}, {"measured"}
# Column, roles that are right, and kind with unit; where neither the file nor EDP has a unit for it, numbers are right:
# the authors of the bench state no scale, watts and kilowatts are no unit of a channel.
TRUTH = {
    "cascaded_tanks/dataBenchmark.csv": {
        "uEst": (INPUT, NUMBERS),
        "uVal": (INPUT, NUMBERS),
        "yEst": (OUTPUT, NUMBERS),
        "yVal": (OUTPUT, NUMBERS),
        "Ts": (TIME, NUMBERS),
    },
    "emps": {"t": (TIME, NUMBERS), "vir": (INPUT, NUMBERS), "qm": (OUTPUT, NUMBERS), "qg": (INPUT, NUMBERS)},
    "fatigue_rig_faster/faster.csv": {
        "t": (TIME, NUMBERS),
        "r": (INPUT, NUMBERS),
        "u": (INPUT, NUMBERS),
        "y": (OUTPUT, NUMBERS),
        "d": (OUTPUT, NUMBERS),
    },
    "hydraulic_actuator_sjoberg/actuator.mat": {
        "u": (INPUT, NUMBERS),
        "p": (OUTPUT, NUMBERS),
        "x": (OUTPUT, NUMBERS),
    },
    "hydraulic_bench_mataveid/HangingLoad.csv": {
        "column_1": (TIME, NUMBERS),
        "column_2": (INPUT, NUMBERS),
        "column_3": (OUTPUT, NUMBERS),
        "column_4": (INPUT, NUMBERS),
    },
    "hydraulic_bench_mataveid/MotorRotation.csv": {
        "column_1": (TIME, NUMBERS),
        "column_2": (INPUT, NUMBERS),
        "column_3": (OUTPUT, NUMBERS),
    },
    "hydraulic_bench_mataveid/MultivariableCylinders.csv": {
        "column_1": (TIME, NUMBERS),
        "column_2": (INPUT, NUMBERS),
        "column_3": (INPUT, NUMBERS),
        "column_4": (OUTPUT, NUMBERS),
        "column_5": (OUTPUT, NUMBERS),
    },
    "hydraulic_condition_uci/condition_1hz.parquet": {
        "cycle": ({"counter"}, NUMBERS),
        "second": (TIME, NUMBERS),
        **{f"PS{i}": (OUTPUT, BAR) for i in range(1, 7)},
        "EPS1": (OUTPUT, NUMBERS),
        **{f"FS{i}": (OUTPUT, FLOW) for i in range(1, 3)},
        **{f"TS{i}": (OUTPUT, CELSIUS) for i in range(1, 5)},
        "VS1": (OUTPUT, NUMBERS),
        "SE": (OUTPUT, SHARE),
        "CE": (OUTPUT, SHARE),
        "CP": (OUTPUT, NUMBERS),
        "cooler_percent": ({"label"}, SHARE),
        "valve_percent": ({"label"}, SHARE),
        "pump_leak": ({"label"}, NUMBERS),
        "accumulator_bar": ({"label"}, BAR),
        "stable_flag": ({"label"}, NUMBERS),
    },
}
RATES = {
    "cascaded_tanks/dataBenchmark.csv": 0.25,
    "emps": 1000.0,
    "fatigue_rig_faster/faster.csv": 128.98,
    "hydraulic_bench_mataveid/HangingLoad.csv": 50.0,
    "hydraulic_bench_mataveid/MotorRotation.csv": 50.0,
    "hydraulic_bench_mataveid/MultivariableCylinders.csv": 10.0,
    "hydraulic_condition_uci/condition_1hz.parquet": 1.0,
}


def proposed(name: str):
    path = ROOT / name
    if not path.exists():
        pytest.skip(f"'{path}' is not there; set EDP_SHARED_DATA to the folder of real recordings")
    return propose(path)


@pytest.mark.parametrize("name", TRUTH)
def test_nine_of_ten_columns_are_right_and_none_is_wrong_without_saying_so(name):
    proposal = proposed(name).proposal
    guesses = {guess.column: guess for guess in proposal.columns}
    truth = TRUTH[name]
    assert set(truth) <= set(guesses)
    right = []
    for column, (roles, kind) in truth.items():
        guess = guesses[column]
        fits = guess.role in roles and (str(guess.kind.kind), guess.kind.unit) == kind
        right.append(fits)
        # What is wrong is marked, and taken as numbers.
        assert fits or (guess.confidence < BOUND and guess.check and (guess.kind.unit == "1")), guess
    assert sum(right) >= 0.9 * len(truth), [column for column, fits in zip(truth, right) if not fits]


@pytest.mark.parametrize("name", RATES)
def test_rates(name):
    assert proposed(name).proposal.clock.rate_hz == pytest.approx(RATES[name], rel=1e-3)


def test_experiments_side_by_side_become_two_recordings():
    proposal = proposed("cascaded_tanks")
    assert proposal.targets == ("y",)
    assert 'test = [\n    "dataBenchmark_val"' in proposal.files[SETTINGS]
    assert MAP not in proposal.files


def test_a_folder_of_logs_with_other_columns_names_them():
    proposal = proposed("hydraulic_bench_mataveid")
    assert [path.name for path in proposal.group.paths] == ["HangingLoad.csv"]
    assert sum("other columns" in note for note in proposal.notes) == 2
    assert proposal.commands(Path("here"))[0] == "edp data check here/data.toml --inputs column_4"


def test_no_time_is_said():
    proposal = proposed("hydraulic_actuator_sjoberg")
    assert proposal.proposal.clock.confidence < BOUND
    assert any("no time found" in note for note in proposal.notes)
