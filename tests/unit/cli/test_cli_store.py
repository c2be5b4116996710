"""`edp data store`, and commands that take a store in place of logs."""

import pytest


def test_a_store_is_built_checked_and_trained_on(edp, logs, small, tmp_path):
    built = edp("data", "store", "build", logs, "--out", tmp_path / "store", "--workers", 1, "--json")
    assert (built.code, built.json["recordings"], built.json["refused"]) == (0, 5, [])
    assert edp("data", "store", "verify", tmp_path / "store", "--json").json == built.json
    shown = edp("data", "store", "build", logs, "--out", tmp_path / "store", "--workers", 1)
    assert f"next: edp data check {tmp_path / 'store'}" in shown.out
    scores = []
    for data in (logs, tmp_path / "store"):
        run = tmp_path / f"run_{data.name}"
        assert edp("train", data, "--out", run, *small, "--json").code == 0
        # The test logs are read again from where the run says that they are.
        judged = edp("evaluate", run, "--baselines", "persistence", "--json")
        assert judged.code in (0, 6)
        scores.append({name: model["overall"] for name, model in judged.json["models"].items()})
    assert scores[0] == scores[1]


def test_refused_logs_end_with_a_code_of_their_own(edp, logs, tmp_path):
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "good.parquet").write_bytes((logs / "drive_0.parquet").read_bytes())
    (tmp_path / "logs" / "bad.parquet").write_bytes(b"PAR1 and no more")
    ended = edp("data", "store", "build", tmp_path / "logs", "--out", tmp_path / "store", "--workers", 1)
    assert ended.code == 3
    assert "bad.parquet" in ended.out
    assert "1 log left out of the store" in ended.err
    assert edp("data", "check", tmp_path / "store", "--no-coverage").code == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["data", "check", "{store}", "--map", "{map}"], "--map came with the store"),
        (["train", "{store}", "--out", "{new}", "--repair", "nan=hold"], "--repair came with the store"),
        (["data", "store", "build", "{store}", "--out", "{new}"], "is a store already"),
        (["data", "store", "build", "{logs}", "--out", "{logs}"], "is no store and not empty"),
        (["data", "store", "verify", "{logs}"], "is no store: it has no store.json"),
        (["data", "store", "build", "{new}", "--out", "{other}"], "does not exist"),
    ],
)
def test_what_does_not_go_with_a_store_is_one_error(edp, logs, tmp_path, arguments, message):
    places = {name: tmp_path / name for name in ("store", "new", "other")}
    edp("data", "store", "build", logs, "--out", places["store"], "--workers", 1)
    (tmp_path / "map.toml").write_text('[channels.CylVels_1]\ncolumn = "CylVels_1"\n')
    places |= {"logs": logs, "map": tmp_path / "map.toml"}
    ended = edp(*(argument.format(**places) for argument in arguments))
    assert ended.code == 1
    assert message in ended.err
    assert not places["new"].exists()
