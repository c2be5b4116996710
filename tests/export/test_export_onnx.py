"""The ONNX graphs against PyTorch in ONNX Runtime, for every network that the registries allow, and their rules."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from edp.errors import ConfigError, ExportError
from edp.export import make_target
from edp.export.golden import random_inputs, stream, tolerance
from edp.export.onnx import nodes as nodes_file
from edp.export.onnx.memory import STEPS
from edp.export.onnx.nodes import ALLOWED, OPSETS, Nodes
from edp.export.onnx.plain import PLAIN
from edp.export.onnx.step import INPUTS, SPOILT, states_of, step_model
from edp.export.onnx.target import OnnxTarget
from edp.export.onnx.window import rows_needed, window_model
from edp.graph import Graph, Layer, memory
from edp.graph.reference import STEPS as REFERENCE

needed = "needs the packages onnx and onnxruntime: pip install 'excavator-dynamics-predictor[dev]'"
onnx = pytest.importorskip("onnx", reason=needed)
runtime = pytest.importorskip("onnxruntime", reason=needed)

NETWORKS = ("hybrid+all", "hybrid9", "tcn+all", "gru+quantiles", "lstm2", "lstm+hybrid physics")
"""Among them all kinds of layers."""


def session(model):
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    return runtime.InferenceSession(model, options, providers=["CPUExecutionProvider"])


class StepStream:
    """A stream through a step graph."""

    def __init__(self, graph, targets, opset=13):
        self.graph, self.states = graph, states_of(graph)
        self.run = session(step_model(graph, targets, "step", {}, opset))
        self.names = [output.name for output in self.run.get_outputs()]
        self.reset()

    def reset(self):
        self.held = {state.name: state.start for state in self.states}

    def __call__(self, rows):
        found = []
        for row in rows:
            made = dict(zip(self.names, self.run.run(None, {INPUTS: row[None], **self.held})))
            self.held = {state.name: made[state.next] for state in self.states}
            found.append(np.concatenate([made[meaning].ravel() for meaning in self.graph.results]))
        return np.array(found)


@pytest.fixture(scope="session")
def step_of(bundle_of):
    def make(structure, opset=13):
        predictor = bundle_of(structure).predictor
        return predictor, StepStream(predictor.graph(), len(predictor.task.targets), opset)

    return make


def held_to_pytorch(predictor, run, ticks):
    inputs = random_inputs(predictor, ticks, seed=5)
    wanted = stream(predictor, inputs)
    assert np.isfinite(wanted).all()
    return float((np.abs(run(inputs) - wanted) / tolerance(predictor, inputs, wanted)).max())


@pytest.mark.covering
def test_the_step_predicts_what_pytorch_predicts(structure, bundle_of, step_of):
    """Within 1e-5 of a standard deviation and of the largest value."""
    assert held_to_pytorch(*step_of(structure), 60) < 1


def window_differs_by(predictor, opset=13, seeds=2):
    graph = predictor.graph()
    run, worst = session(window_model(graph, len(predictor.task.targets), "window", {}, opset)), 0.0
    for seed in range(seeds):
        inputs = random_inputs(predictor, graph.window, seed)
        wanted = stream(predictor, inputs)
        found = np.concatenate([made.ravel() for made in run.run(None, {INPUTS: inputs})])
        worst = max(worst, float((np.abs(found - wanted[-1]) / tolerance(predictor, inputs, wanted)).max()))
    return worst


@pytest.mark.covering
def test_the_window_predicts_what_pytorch_predicts_from_reset(structure, bundle_of):
    assert window_differs_by(bundle_of(structure).predictor) < 1


@pytest.mark.covering
def test_every_value_of_a_graph_is_read(structure, bundle_of):
    """ONNX Runtime up to 1.18 lays what nobody reads over what is still needed, from the second run on."""
    predictor = bundle_of(structure).predictor
    graph, targets = predictor.graph(), len(predictor.task.targets)
    for make in (step_model, window_model):
        made = onnx.load_from_string(make(graph, targets, "graph", {})).graph
        read = {name for node in made.node for name in node.input} | {output.name for output in made.output}
        assert not [name for node in made.node for name in node.output if name and name not in read]


@pytest.mark.parametrize("ticks", [1, 2, 4, 5, 6, 15])
@pytest.mark.parametrize("network", NETWORKS)
def test_windows_of_other_lengths(network, ticks, bundle_of):
    """Shorter than what layers look back, no longer than the first ticks that are corrected, longer than a mean."""
    predictor = bundle_of(network).predictor
    graph = replace(predictor.graph(), window=ticks)
    inputs = random_inputs(predictor, ticks, seed=2)
    wanted = stream(predictor, inputs)
    run = session(window_model(graph, len(predictor.task.targets), "window", {}))
    found = np.concatenate([made.ravel() for made in run.run(None, {INPUTS: inputs})])
    assert (np.abs(found - wanted[-1]) <= tolerance(predictor, inputs, wanted)).all()


def test_a_window_computes_no_more_rows_than_it_needs(bundle_of):
    graph = bundle_of("tcn").predictor.graph()
    need = rows_needed(graph, 50)
    convolutions = [need[layer.name] for layer in graph.layers if isinstance(layer, memory.Convolution)]
    assert convolutions == sorted(convolutions, reverse=True)
    assert convolutions[-1] == 1
    assert need["input"] < 25
    assert all(need[value] == 1 for value in graph.results.values())


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_bad_input_anywhere_in_the_window_shows(bad, bundle_of):
    predictor = bundle_of("tcn+all").predictor
    graph = predictor.graph()
    run = session(window_model(graph, len(predictor.task.targets), "window", {}))
    inputs = random_inputs(predictor, graph.window, seed=1)
    assert np.isfinite(run.run(None, {INPUTS: inputs})[0]).all()
    for tick in (0, graph.window - 1):
        spoilt = inputs.copy()
        spoilt[tick, 1] = bad
        assert np.isnan(run.run(None, {INPUTS: spoilt})[0]).all()
    with pytest.raises(Exception, match=r"(?i)invalid|unexpected"):
        run.run(None, {INPUTS: inputs[1:]})


@pytest.mark.slow
@pytest.mark.parametrize("network", NETWORKS)
def test_the_step_follows_pytorch_for_a_long_time(network, step_of):
    assert held_to_pytorch(*step_of(network), 20_000) < 1


@pytest.mark.parametrize("opset", OPSETS)
@pytest.mark.parametrize("network", NETWORKS)
def test_every_opset_gives_the_same_numbers(network, opset, step_of):
    assert held_to_pytorch(*step_of(network, opset), 25) < 1
    assert window_differs_by(step_of(network)[0], opset, 1) < 1


@pytest.mark.parametrize("network", ["tcn", "hybrid+all"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_bad_inputs_show_until_the_reset(network, bad, step_of):
    """ReLU swallows a NaN: without a state of its own it would be a wrong number some ticks later."""
    predictor, run = step_of(network)
    inputs = random_inputs(predictor, 60, seed=4)
    fresh = run(inputs)
    spoilt = inputs.copy()
    spoilt[10, 0] = bad
    run.reset()
    found = run(spoilt)
    np.testing.assert_array_equal(found[:10], fresh[:10])
    assert np.isnan(found[10:]).all()
    run.reset()
    np.testing.assert_array_equal(run(inputs), fresh)


def test_two_streams_do_not_know_of_each_other(step_of):
    predictor, run = step_of("hybrid+all")
    a, b = (random_inputs(predictor, 20, seed=seed) for seed in (1, 2))
    alone = run(a)
    run.reset()
    held, found = [run.held, run.held], []
    for pair in zip(a, b):
        for which, row in enumerate(pair):
            run.held = held[which]
            made = run(row[None])
            held[which] = run.held
            if which == 0:
                found.append(made[0])
    np.testing.assert_array_equal(found, alone)


def test_what_does_not_fit_is_refused_by_the_runtime(step_of):
    predictor, run = step_of("hybrid")
    good = random_inputs(predictor, 1, seed=0)
    for bad in (good[:, :-1], np.concatenate([good, good], axis=1), np.repeat(good, 2, axis=0), good.astype(float)):
        with pytest.raises(Exception, match=r"(?i)invalid|unexpected"):
            run.run.run(None, {INPUTS: bad, **run.held})
    first = next(iter(run.held))
    with pytest.raises(Exception, match=r"(?i)required input|missing"):
        run.run.run(None, {INPUTS: good, **{key: value for key, value in run.held.items() if key != first}})


@pytest.mark.parametrize("opset", OPSETS)
def test_files_are_clean(opset, bundle_of, tmp_path):
    bundle = bundle_of("hybrid+all")
    files = OnnxTarget(opset).write(bundle, "arm", tmp_path)
    read = {file.name: file.read_bytes() for file in files}
    assert sorted(read) == sorted(file.name for file in tmp_path.iterdir())
    OnnxTarget(opset).write(bundle, "arm", tmp_path)
    assert {file.name: file.read_bytes() for file in files} == read  # the same network gives the same bytes
    described = json.loads(read["arm.json"])
    for graph in described["graphs"].values():
        model = onnx.load_from_string(read[graph["file"]])
        onnx.checker.check_model(model, full_check=True)
        assert (model.ir_version, model.opset_import[0].version) == (OPSETS[opset], opset) == (graph["ir"], opset)
        assert {node.op_type for node in model.graph.node} <= ALLOWED
        assert all(node.domain == "" for node in model.graph.node)
        sides = (*model.graph.input, *model.graph.output)
        assert [d.dim_value for d in model.graph.input[0].type.tensor_type.shape.dim] == graph["shape"]
        assert all(d.dim_value > 0 for v in sides for d in v.type.tensor_type.shape.dim)  # no open shapes
        kept = {entry.key: entry.value for entry in model.metadata_props}
        assert (
            json.loads(kept["inputs"]) == [entry["name"] for entry in described["inputs"]] == list(bundle.task.inputs)
        )
        assert kept["model_hash"] == described["model_hash"]


def test_the_description_is_enough_to_stream(bundle_of, tmp_path):
    """Nothing but the two files; the hidden start of this network was learned."""
    bundle = bundle_of("hybrid8")
    OnnxTarget().write(bundle, "predictor", tmp_path)
    described = json.loads((tmp_path / "predictor.json").read_text())
    graph = described["graphs"]["step"]
    run = session((tmp_path / graph["file"]).read_bytes())
    held = {
        state["name"]: np.broadcast_to(np.float32(state["start"]), state["shape"]).copy() for state in graph["states"]
    }
    assert any(isinstance(state["start"], list) for state in graph["states"])
    inputs, found = random_inputs(bundle.predictor, 30, seed=3), []
    wanted = stream(bundle.predictor, inputs)
    names = [output.name for output in run.get_outputs()]
    for row in inputs:
        made = dict(zip(names, run.run(None, {graph["input"]: row[None], **held})))
        held = {state["name"]: made[state["next"]] for state in graph["states"]}
        assert made["prediction"].shape == tuple(described["results"]["prediction"])
        found.append(made["prediction"].ravel())
    assert (np.abs(found - wanted) <= tolerance(bundle.predictor, inputs, wanted)).all()
    assert [entry["name"] for entry in described["targets"]] == list(bundle.task.targets)
    assert {"rate_hz", "window", "mode", "horizons", "rules", "scale_hash", "coverages"} <= set(described)


def test_matlab_reads_the_description(bundle_of, tmp_path):
    bundle = bundle_of("hybrid8")
    OnnxTarget().write(bundle, "predictor", tmp_path)
    read = scipy.io.loadmat(tmp_path / "predictor.mat", simplify_cells=True)
    described = json.loads((tmp_path / "predictor.json").read_text())
    about, golden = read["edp"], read["golden"]
    assert set(about) == set(described)
    assert [entry["name"] for entry in about["inputs"]] == list(bundle.task.inputs)
    for key in ("window", "rate_hz", "mode", "model_hash"):
        assert about[key] == described[key]
    graphs = {name: session((tmp_path / entry["file"]).read_bytes()) for name, entry in about["graphs"].items()}
    held = {
        s["name"]: np.float32(s["start"]).reshape(s["shape"].astype(int)) for s in about["graphs"]["step"]["states"]
    }
    assert any(np.ptp(start) > 0 for start in held.values())
    found = graphs["step"].run(None, {INPUTS: golden["inputs"][:1], **held})[0].ravel()
    assert (np.abs(found - golden["stream"][0]) <= golden["tolerance"]).all()
    found = graphs["window"].run(None, {INPUTS: golden["inputs"][-described["window"] :]})[0].ravel()
    assert (np.abs(found - golden["window"]) <= golden["tolerance"]).all()
    if shutil.which("octave") is None:
        pytest.skip("needs the Debian package octave (make system-packages)")
    program = "load predictor.mat; printf('%s ', edp.inputs{2}.name, edp.graphs.step.states{1}.next); disp(edp.window)"
    command = ["octave", "--norc", "--no-gui", "--eval", program]
    printed = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True).stdout.split()
    state = described["graphs"]["step"]["states"][0]
    assert printed == [bundle.task.inputs[1], state["next"], str(described["window"])]


def test_every_kind_of_layer_has_nodes():
    assert set(PLAIN) | set(STEPS) == set(REFERENCE)
    assert not set(PLAIN) & set(STEPS)


class Strange(Layer):
    @property
    def width(self):
        return 1


def test_what_cannot_be_written_is_refused_by_name(bundle_of, tmp_path, monkeypatch):
    graph = Graph(1, (Strange(name="odd.one", inputs=("input",)),), {"prediction": "odd.one"})
    with pytest.raises(ExportError, match=r"layer 'odd\.one' is a Strange, .* these have: Accumulate"):
        step_model(graph, 1, "step", {})
    with pytest.raises(ExportError, match=r"'odd\.one' is a Strange"):
        window_model(graph, 1, "window", {})
    learned = bundle_of("hybrid9").predictor.graph()
    late = {"inputs": (learned.results["prediction"],), "ticks": 1}
    rest = tuple(replace(x, **late) if isinstance(x, memory.PrefixCorrection) else x for x in learned.layers)
    with pytest.raises(ExportError, match="use the graph of a tick"):
        window_model(replace(learned, layers=rest), 2, "window", {})
    with pytest.raises(ExportError, match="opset 12 is not written; choose one of 9, 11, 13"):
        OnnxTarget(12)
    with pytest.raises(ExportError, match="opset 8"):
        Nodes(8)
    with pytest.raises(ExportError, match="operator Loop"):
        Nodes().add("Loop", "x")
    for name in ("Arm", "2arm", "a-b", "../arm", "", "a" * 40):
        with pytest.raises(ExportError, match="--name"):
            OnnxTarget().write(bundle_of("lstm"), name, tmp_path)
    with pytest.raises(ConfigError, match=r"'c' has no option 'opset'"):
        make_target("c", {"opset": 9})
    with pytest.raises(ConfigError, match=r"no option 'opsett' \(it has opset\)"):
        make_target("onnx", {"opsett": 9})
    with pytest.raises(ExportError, match=r"whole numbers \(w8a16\), which ONNX does not hold; export the run"):
        OnnxTarget().write(bundle_of("lstm", whole=True), "arm", tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ExportError, match=r"pip install 'excavator-dynamics-predictor\[onnx\]'"):
        nodes_file.library()
    assert not list(tmp_path.iterdir())


def test_names_of_states_are_their_own(bundle_of):
    for network in NETWORKS:
        graph = bundle_of(network).predictor.graph()
        states = states_of(graph)
        names = [name for state in states for name in (state.name, state.next)]
        assert len(set(names)) == len(names)
        assert states[-1].name == SPOILT
        assert sum(state.start.size for state in states) == 1 + sum(slot.size for _, slot in graph.slots())


def test_corrections_reach_the_states_of_other_layers(bundle_of):
    kinds = {type(layer) for network in NETWORKS for layer in bundle_of(network).predictor.graph().layers}
    assert memory.PrefixCorrection in kinds
    assert memory.WindowAttention in kinds


def test_the_page_lists_the_operators(bundle_of):
    page = (Path(__file__).parents[2] / "docs/onnx.md").read_text()
    listed = page.partition("## Operators")[2].partition("and no others")[0]
    assert set(re.findall(r"[A-Z]\w+", listed)) == ALLOWED
    used = set()
    for network in (*NETWORKS, "lstm+normal", "hybrid"):
        predictor = bundle_of(network).predictor
        for write in (step_model, window_model):
            model = onnx.load_from_string(write(predictor.graph(), len(predictor.task.targets), "graph", {}))
            kinds = {node.op_type for node in model.graph.node}
            assert write is window_model or not kinds & {"Conv", "GRU", "LSTM", "Transpose"}
            assert all(len(v.type.tensor_type.shape.dim) == 2 for v in (*model.graph.input, *model.graph.output))
            used |= kinds
    assert used == ALLOWED


OLD = """
import json, sys
import numpy as np
import onnxruntime as o

for case in json.load(open("cases.json")):
    options = o.SessionOptions()
    options.intra_op_num_threads, options.log_severity_level = 1, 3
    run, rows = o.InferenceSession(case["graph"], options, providers=["CPUExecutionProvider"]).run, []
    held = {name: np.array(start, np.float32) for name, start in case["states"]}
    names = case["results"] + case["next"]
    for row in np.load(case["inputs"]):
        made = dict(zip(names, run(names, {"inputs": row, **held})))
        held = {name: made[then] for (name, _), then in zip(case["states"], case["next"])}
        rows.append(np.concatenate([made[name].ravel() for name in case["results"]]))
    np.save(case["found"], np.array(rows))
"""


@pytest.mark.slow
def test_an_old_onnx_runtime_says_the_same(bundle_of, parts, tmp_path):
    """``EDP_OLD_ONNXRUNTIME`` names a Python that has it, such as 1.15.1, which readers of that time are built on."""
    python = os.environ.get("EDP_OLD_ONNXRUNTIME", "")
    if not python:
        pytest.skip("needs EDP_OLD_ONNXRUNTIME, a Python with an old onnxruntime")
    cases, wanted = [], {}
    for number, structure in enumerate(parts[0]):
        predictor = bundle_of(structure).predictor
        graph, targets = predictor.graph(), len(predictor.task.targets)
        inputs = random_inputs(predictor, 3 * graph.window, seed=4)
        windows = np.stack([inputs[at : at + graph.window] for at in range(2 * graph.window)])
        said = stream(predictor, inputs)
        each = np.concatenate([stream(predictor, window)[-1:] for window in windows])
        allowed = tolerance(predictor, inputs, said)
        for kind, make, rows, right in (
            ("step", step_model, inputs[:, None], said),
            ("window", window_model, windows, each),
        ):
            name = f"{number}_{kind}"
            (tmp_path / f"{name}.onnx").write_bytes(make(graph, targets, "graph", {}))
            np.save(tmp_path / f"{name}_in.npy", rows)
            states = states_of(graph) if kind == "step" else []
            case = {"graph": f"{name}.onnx", "inputs": f"{name}_in.npy", "found": f"{name}_out.npy"}
            case |= {"results": list(graph.results), "next": [state.next for state in states]}
            cases.append(case | {"states": [(state.name, state.start.tolist()) for state in states]})
            wanted[name, structure] = right, allowed
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    subprocess.run([python, "-c", OLD], cwd=tmp_path, check=True)
    for (name, structure), (right, allowed) in wanted.items():
        found = np.load(tmp_path / f"{name}_out.npy")
        assert (np.abs(found - right) <= allowed).all(), (structure, name)
