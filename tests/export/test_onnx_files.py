"""Exported ONNX files: what lies in them and in their description, what is refused, and old readers of them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import scipy.io

from edp.errors import ConfigError, ExportError
from edp.export import make_target
from edp.export.folder import LIST
from edp.export.golden import random_inputs, stream, tolerance
from edp.export.onnx import nodes as nodes_file
from edp.export.onnx.nodes import ALLOWED, OPSETS, Nodes
from edp.export.onnx.step import INPUTS, states_of, step_model
from edp.export.onnx.target import OnnxTarget
from edp.export.onnx.window import window_model
from edp.ir import Graph, Layer, memory

needed = "needs the packages onnx and onnxruntime: pip install 'excavator-dynamics-predictor[dev]'"
onnx = pytest.importorskip("onnx", reason=needed)
runtime = pytest.importorskip("onnxruntime", reason=needed)


@pytest.mark.parametrize("opset", OPSETS)
def test_files_are_clean(opset, bundle_of, tmp_path):
    bundle = bundle_of("hybrid+all")
    files = OnnxTarget(opset).write(bundle, "arm", tmp_path)
    read = {file.name: file.read_bytes() for file in files}
    assert sorted([*read, LIST]) == sorted(file.name for file in tmp_path.iterdir())
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


def test_the_description_is_enough_to_stream(bundle_of, onnx_session, tmp_path):
    """Nothing but the two files; the hidden start of this network was learned."""
    bundle = bundle_of("hybrid8")
    OnnxTarget().write(bundle, "predictor", tmp_path)
    described = json.loads((tmp_path / "predictor.json").read_text())
    graph = described["graphs"]["step"]
    run = onnx_session((tmp_path / graph["file"]).read_bytes())
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


def test_matlab_reads_the_description(bundle_of, onnx_session, tmp_path):
    bundle = bundle_of("hybrid8")
    OnnxTarget().write(bundle, "predictor", tmp_path)
    read = scipy.io.loadmat(tmp_path / "predictor.mat", simplify_cells=True)
    described = json.loads((tmp_path / "predictor.json").read_text())
    about, golden = read["edp"], read["golden"]
    assert set(about) == set(described)
    assert [entry["name"] for entry in about["inputs"]] == list(bundle.task.inputs)
    for key in ("window", "rate_hz", "mode", "model_hash"):
        assert about[key] == described[key]
    graphs = {name: onnx_session((tmp_path / entry["file"]).read_bytes()) for name, entry in about["graphs"].items()}
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
    with pytest.raises(ExportError, match=r"integer arithmetic \(w8a16\), which ONNX does not hold; export the run"):
        OnnxTarget().write(bundle_of("lstm", whole=True), "arm", tmp_path)
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ExportError, match=r"pip install 'excavator-dynamics-predictor\[onnx\]'"):
        nodes_file.library()
    assert not list(tmp_path.iterdir())


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
