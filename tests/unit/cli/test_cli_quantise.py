"""``edp compress quantise``: a run in integers is judged and exported as such."""

from __future__ import annotations

import json

import numpy as np

from edp.networks import Stream
from edp.networks.integer import IntegerPredictor
from edp.training import load_bundle
from edp.training.bundle import INTEGER_SCHEMA


def test_a_quantised_run_is_judged_and_exported_in_whole_numbers(edp, trained, tmp_path):
    whole = tmp_path / "whole"
    found = edp("compress", "quantise", trained, "--out", whole, "--ticks", 1000, "--json").json
    assert 0 < found["integer"] < 1.2 * found["float"]
    (listed,) = edp("runs", whole, "--json").json["runs"]
    assert listed["state"] == "finished"
    network = load_bundle(whole).predictor
    assert isinstance(network, IntegerPredictor)
    other = load_bundle(trained).predictor
    row = network.front.offset.numpy()[: network.front.inputs]
    assert Stream(network).step(row).prediction.shape == Stream(other).step(row).prediction.shape
    scores = edp("evaluate", whole, "--baselines", "persistence", "--json").json
    held = edp("evaluate", trained, "--baselines", "persistence", "--json").json
    mae = [run["models"]["network"]["overall"]["10"]["mean"]["mae"] for run in (scores, held)]
    assert mae[0] != mae[1]
    np.testing.assert_allclose(mae[0], mae[1], rtol=0.2)
    header = json.loads((whole / "bundle" / "bundle.json").read_text())
    assert (header["schema"], header["number_format"]) == (INTEGER_SCHEMA, "w8a16")
    assert load_bundle(whole).scores
    counts = [edp("compress", "estimate", run, "--json").json for run in (whole, trained)]
    assert counts[0] == counts[1]
    made = edp("export", whole, "--to", "c", "--out", tmp_path / "c", "--json").json
    assert any(file.endswith("edp_integer.c") for file in made["files"])


def test_what_cannot_be_quantised_is_said(edp, trained, tmp_path):
    whole = tmp_path / "whole"
    edp("compress", "quantise", trained, "--out", whole, "--ticks", 1000)
    again = edp("compress", "quantise", whole, "--out", tmp_path / "twice")
    assert again.code == 1
    assert "computes in w8a16 already; give the float run" in again.err
    over = edp("compress", "quantise", trained, "--out", trained)
    assert over.code == 1
    assert "holds another run" in over.err
    assert not (tmp_path / "twice").exists()
    assert load_bundle(trained).predictor.number_format == "float32"
