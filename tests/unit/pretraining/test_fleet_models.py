"""A fleet: a delta a machine, the network of one machine, the report, and the registry with its lineage."""

import json
import shutil

import numpy as np
import pytest
from fleet_reports import fleet_report
from noted_progress import NotedProgress

from edp.errors import BundleError, ConfigError, DataError, EdpError, StorageError
from edp.jobs import Workers
from edp.logs.source import DataSource
from edp.report.fleet.facts import fleet_facts, headline, machine_table, verdict, worst_table
from edp.report.fleet.page import build_fleet_page
from edp.storage import write_json
from edp.training import load_bundle
from edp.training.bundle import weights_digest
from edp.training.delta import apply_delta, read_delta
from edp.workflows.fleet import personal
from edp.workflows.fleet.judge_fleet import PAGE, FleetQuestion, drift_of, report_fleet
from edp.workflows.fleet.personal import PersonalOrder, finetune_fleet, network_of, read_fleet
from edp.workflows.fleet.registry import (
    add_to_registry,
    check_entry,
    find_entry,
    lineage,
    list_registry,
)
from edp.workflows.pretraining import Pretrain, pretrain
from edp.workflows.transfer import FinetuneSpec

pytestmark = pytest.mark.processes

HERE = Workers()
ORDER = PersonalOrder(
    spec=FinetuneSpec(single_phase_epochs=3, batch=4, learning_rate=2e-2, patience=0, check_signs=False)
)


@pytest.fixture(scope="module")
def store(machines, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet") / "store"
    machines.store(folder)
    return folder


@pytest.fixture(scope="module")
def run(store, experiment, tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet") / "run"
    pretrain(DataSource.from_path(store), experiment, Pretrain(), folder)
    return folder


@pytest.fixture(scope="module")
def own(run, store, tmp_path_factory):
    """The folder of a fleet whose machines have deltas."""
    folder = tmp_path_factory.mktemp("fleet") / "own"
    finetune_fleet(HERE, run, store, ORDER, folder)
    return folder


def test_each_machine_of_a_store_has_a_delta_that_is_nearly_its_fine_tuning(own, run, store):
    content = read_fleet(own)
    assert [row.machine for row in content.machines] == [f"Press-{n}" for n in range(6)]
    assert content.base == weights_digest(load_bundle(run).predictor)
    for row in content.machines:
        file = own / row.delta
        assert file.stat().st_size == row.bytes <= 64 * 1024
        assert read_delta(file).facts["machine"] == row.machine
        # A small network within 64 kB loses next to nothing; half precision is the whole difference.
        assert row.mae.delta == pytest.approx(row.mae.full, rel=0.02)
    errors = np.array([[row.mae.before, row.mae.delta] for row in content.machines])
    assert errors[:, 1].mean() < errors[:, 0].mean()


def test_a_machine_that_is_done_is_not_done_again(own, run, store, monkeypatch, tmp_path):
    shutil.copytree(own, tmp_path / "own")
    monkeypatch.setattr(personal, "target_data", lambda *_: pytest.fail("a machine was done twice"))
    told = NotedProgress()
    content = finetune_fleet(HERE, run, store, ORDER, tmp_path / "own", told)
    assert content == read_fleet(own)
    assert told.stages == [("machine", 6)]
    assert told.steps[-1] == 6


def test_the_network_of_one_machine_is_a_bundle(own, run, tmp_path):
    folder = network_of(own, "Press-3", tmp_path / "press3")
    row = read_fleet(own).machines[3]
    wanted = apply_delta(load_bundle(run).predictor, read_delta(own / row.delta))
    assert weights_digest(load_bundle(folder).predictor) == weights_digest(wanted)
    with pytest.raises(ConfigError, match=r"no machine 'Press-9'.*Press-"):
        network_of(own, "Press-9", tmp_path / "no")
    with pytest.raises(BundleError, match="is a change of the network"):
        network_of(own, "Press-3", tmp_path / "no", folder)


def test_machines_whose_logs_do_not_go_are_told_and_the_others_go_on(run, store, tmp_path, monkeypatch):
    real = personal.target_data

    def picky(base, logs, *others):
        if logs.machine == "Press-1":
            raise DataError("lever has another unit")
        return real(base, logs, *others)

    monkeypatch.setattr(personal, "target_data", picky)
    order = PersonalOrder(spec=FinetuneSpec(single_phase_epochs=1, batch=4, check_signs=False))
    rows = finetune_fleet(HERE, run, store, order, tmp_path / "own").machines
    assert rows[1].failed == "lever has another unit"
    assert [row.delta is not None for row in rows] == [True, False, True, True, True, True]
    with pytest.raises(ConfigError, match="has no network of its own: lever has another unit"):
        network_of(tmp_path / "own", "Press-1", tmp_path / "no")


def test_logs_that_are_no_store_or_say_no_machine_are_refused(machines, run, tmp_path):
    with pytest.raises(ConfigError, match="is no store"):
        finetune_fleet(HERE, run, machines.path, ORDER, tmp_path / "no")
    with pytest.raises(ConfigError, match="cannot make the networks of a fleet"):
        PersonalOrder(method="direct")
    with pytest.raises(ConfigError, match="a delta of 7 bytes"):
        PersonalOrder(most_bytes=7)


def test_a_damaged_fleet_file_is_one_message(own, tmp_path):
    shutil.copytree(own, tmp_path / "own")
    for content in ("[]", "{", '{"schema": 7, "base": "", "source": "", "machines": []}', '{"schema": 1}'):
        (tmp_path / "own" / "fleet.json").write_text(content)
        with pytest.raises(EdpError, match=r"fleet\.json"):
            read_fleet(tmp_path / "own")


def test_the_report_names_the_worst_and_why(own, run, store, tmp_path):
    facts = report_fleet(HERE, FleetQuestion(network=run, store=store, deltas=own), tmp_path / "report")
    assert len(facts.rows) == 6
    errors = [row.mae for row in facts.rows]
    assert errors == sorted(errors, reverse=True)
    assert all(row.own for row in facts.rows)
    page = (tmp_path / "report" / PAGE).read_text()
    assert facts.rows[0].name in page
    plain = report_fleet(HERE, FleetQuestion(network=run, store=store), tmp_path / "plain")
    assert plain.median > facts.median
    # The press of the largest gain is farthest from the others.
    assert any("times" in reason for reason in plain.rows[0].why)


def row(name, mae, drift=None, alarms=None, level=0.0, still=4.0):
    inputs = {"lever": {"mean": level, "std": 1.0}}
    drift = {"ratio": 1.0, "t": 0.0} if drift is None else drift
    return {
        "machine": name, "minutes": 5.0, "mae": mae, "by_target": [mae, mae], "persistence": still,
        "recordings": [], "drift": drift, "inputs": inputs, "own": False, "alarms": alarms,
    }  # fmt: skip


@pytest.fixture
def content():
    """Twelve machines: one that drifts, one that is fed otherwise, one with alarms, and one that failed."""
    rows = [row(f"m{n}", 1.0 + 0.01 * n, level=0.1 * (n % 3)) for n in range(12)]
    rows[3] = row("m3", 2.0, {"ratio": 1.8, "t": 9.0})
    rows[4] = row("<b>m4</b>", 1.9, level=50.0)
    rows[5] = row("m5", 1.8, alarms={"changes": 2, "alarms": 9, "hours": 0.1, "first": ["pump leaks"]}, still=9.0)
    return {
        "schema": 1, "edp": "0", "network": {"path": "p", "weights": "w", "label": "LSTM"}, "store": "s",
        "deltas": None, "monitor": None, "horizon": 10, "rate_hz": 100.0,
        "targets": [{"name": "v_boom", "unit": "mm/s"}, {"name": "v_arm", "unit": "mm/s"}],
        "machines": [*rows, {"machine": "m12", "minutes": 1.0, "failed": "too short"}],
    }  # fmt: skip


def test_reasons_are_what_departs_from_the_fleet(content):
    facts = fleet_facts(fleet_report(content), "fleet")
    why = {one.name: " ".join(one.why) for one in facts.rows}
    assert "grew by 80 %" in why["m3"]
    assert "input lever lies" in why["<b>m4</b>"]
    assert "2 changes, first: pump leaks" in why["m5"]
    assert "change 2.2 times as fast" in why["m5"]
    assert why["m0"] == ""
    assert headline(facts).startswith("12 machines, median error")
    assert "1 of 12 machines drift" in verdict(facts)[0]
    assert len(worst_table(facts).rows) == 10
    assert machine_table(facts).marked
    page = build_fleet_page(facts).html()
    assert "<b>m4</b>" not in page
    assert "too short" in page


def test_a_fleet_of_which_no_machine_could_be_judged_has_a_page(content):
    content["machines"] = [{"machine": "m", "minutes": 1.0, "failed": "too short"}]
    facts = fleet_facts(fleet_report(content), "fleet")
    assert headline(facts) == "None of 1 machines could be judged."
    assert "too short" in build_fleet_page(facts).html()


def test_drift_is_told_from_chance():
    rng = np.random.default_rng(2)
    steady = np.abs(rng.normal(size=60_000))
    worn = steady * np.repeat([1.0, 1.5], 30_000)
    assert abs(drift_of(steady, 100.0).t) < 4
    found = drift_of(worn, 100.0)
    assert found.t > 4
    assert found.ratio == pytest.approx(1.5, abs=0.05)
    assert drift_of(steady[:5000], 100.0) is None


def test_a_registry_keeps_networks_fleets_and_their_lineage(own, run, tmp_path):
    top = tmp_path / "registry"
    base = add_to_registry(top, run, "foundation")
    fleet = add_to_registry(top, own, "presses")
    alone = add_to_registry(top, network_of(own, "Press-2", tmp_path / "press2"), "press-2")
    assert add_to_registry(top, run, "again") == base
    assert {entry.name for entry in list_registry(top)[0]} == {"foundation", "presses", "press-2"}
    assert (base.base, fleet.base, alone.base) == ("", base.id, base.id)
    assert lineage(top, alone) == [base]
    assert find_entry(top, fleet.id[:8]) == fleet
    assert fleet.judge["delta"] < fleet.judge["before"]
    assert base.data["recordings"] == 12
    for entry in (base, fleet, alone):
        check_entry(top, entry)
    with pytest.raises(ConfigError, match="no entry 'pres'"):
        find_entry(top, "pres")


def test_damage_in_a_registry_is_told(own, run, store, tmp_path):
    top = tmp_path / "registry"
    base, fleet = add_to_registry(top, run, "foundation"), add_to_registry(top, own, "presses")
    next((top / "files" / fleet.id / "deltas").iterdir()).unlink()
    with pytest.raises(StorageError, match="holds other deltas"):
        check_entry(top, fleet)
    write_json(top / "entries" / f"{base.id}.json", {"schema": 1})
    entries, damaged = list_registry(top)
    assert [entry.name for entry in entries] == ["presses"]
    assert len(damaged) == 1
    with pytest.raises(ConfigError, match="is no name of an entry"):
        add_to_registry(top, run, "../up")
    with pytest.raises(ConfigError, match="is no registry"):
        list_registry(tmp_path / "nothing")
    shutil.copytree(own, tmp_path / "own")
    content = json.loads((tmp_path / "own" / "fleet.json").read_text())
    content["machines"][0]["delta"] = "../../secret"
    write_json(tmp_path / "own" / "fleet.json", content)
    with pytest.raises(StorageError, match=r"got '\.\./\.\./secret' as delta"):
        add_to_registry(top, tmp_path / "own", "hostile")
    with pytest.raises(StorageError, match=r"got '\.\./\.\./secret' as delta"):
        report_fleet(HERE, FleetQuestion(network=run, store=store, deltas=tmp_path / "own"), tmp_path / "report")


@pytest.fixture
def told(monkeypatch, capsys):
    """Exit code, JSON or text, and errors of a command."""
    from edp.cli import app
    from edp.cli.console import run_app

    def command(*words):
        monkeypatch.setenv("COLUMNS", "400")
        monkeypatch.setattr("sys.argv", ["edp", *map(str, words)])
        code = run_app(app)
        said = capsys.readouterr()
        return code, json.loads(said.out) if "--json" in words else said.out, said.err

    return command


def test_the_commands_of_a_fleet_say_what_they_did(told, own, run, store, tmp_path):
    code, facts, _ = told("fleet", "report", run, store, "--out", tmp_path / "report", "--deltas", own, "--json")
    assert code == 0
    assert len(facts["machines"]) == 6
    code, text, _ = told("fleet", "report", run, store, "--out", tmp_path / "report")
    assert "The 6 machines with the largest error" in text
    code, facts, _ = told("fleet", "network", own, "Press-1", "--out", tmp_path / "press", "--json")
    assert (code, facts["machine"]) == (0, "Press-1")
    registry = tmp_path / "registry"
    assert told("registry", "add", registry, run, "--name", "base")[0] == 0
    assert told("registry", "add", registry, tmp_path / "press", "--name", "press")[0] == 0
    code, facts, _ = told("registry", "show", registry, "press", "--json")
    assert facts["lineage"] == [facts["base"]]
    assert "from: base" in told("registry", "show", registry, "press")[1]
    assert len(told("registry", "list", registry, "--json")[1]["entries"]) == 2
    assert "press" in told("registry", "list", registry)[1]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (("finetune", "RUN", "--out", "OUT"), "give LOGS of one machine, or --fleet"),
        (("finetune", "RUN", "STORE", "--fleet", "STORE", "--out", "OUT"), "do not go with --fleet"),
        (("finetune", "RUN", "STORE", "--delta-kb", "9", "--out", "OUT"), "no effect without --fleet"),
        (("evaluate", "RUN", "--workers", "2", "--time-budget", "1min"), "--time-budget: it has no effect without"),
        (("inspect", "STORE", "--workers", "2", "--cluster", "127.0.0.1:9"), "expected one of the two"),
        (("fleet", "network", "OWN", "Press-77", "--out", "OUT"), "has no machine 'Press-77'"),
    ],
    ids=lambda value: value[0] if isinstance(value, tuple) else "",
)
def test_contradictions_are_one_message_and_write_nothing(words, error, told, own, run, store, tmp_path):
    places = {"RUN": run, "STORE": store, "OWN": own, "OUT": tmp_path / "out"}
    code, _, errors = told(*(places.get(word, word) for word in words))
    assert code == 1
    assert error in errors
    assert not (tmp_path / "out").exists()
