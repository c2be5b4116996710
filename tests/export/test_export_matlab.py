"""The MATLAB code of a folder for Simulink in Octave: every network, the rules, names, and the S-function as a MEX."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from edp.export.c.model import make_model
from edp.export.description import encode_mat
from edp.export.escape import matlab_names
from edp.export.golden import random_inputs, stream, tolerance
from edp.export.simulink import native as native_file
from edp.export.simulink.folder import Folder
from edp.export.simulink.native import functions_for

TICKS = 24
"""More than two windows of the small networks."""
LONG = 150
"""Ticks over which PyTorch's own error is looked for."""


def natives(structures, bundle_of, octave, top):
    """Differences of the MATLAB code as shares of what is allowed, and statuses, by network; all in one Octave."""
    lines, wanted = ["found = struct();"], {}
    for number, structure in enumerate(structures):
        bundle, folder = bundle_of(structure), top / f"n{number}"
        folder.mkdir()
        inputs = random_inputs(bundle.predictor, LONG, seed=3)
        made = Folder(make_model("arm", bundle), window=False)
        for file, text in made.texts().items():
            (folder / file).write_text(text)
        (folder / "arm.mat").write_bytes(encode_mat({**made.tables(), "inputs": inputs[:TICKS]}))
        outputs = stream(bundle.predictor, inputs)
        wanted[structure] = (f"n{number}", outputs[:TICKS], tolerance(bundle.predictor, inputs, outputs))
        lines += [f"addpath('{folder}'); net = arm_load();", "[y, status] = arm_stream(net, net.inputs);"]
        lines += [f"found.n{number} = y; found.s{number} = status;", f"rmpath('{folder}'); clear -f;"]
    octave("\n".join([*lines, f"save('-v6', '{top}/found.mat', '-struct', 'found');"]), top)
    found = scipy.io.loadmat(top / "found.mat")
    return {
        structure: (np.abs(found[key] - rows) / allowed, found[key.replace("n", "s")].ravel())
        for structure, (key, rows, allowed) in wanted.items()
    }


@pytest.mark.parametrize("which", ["covering", pytest.param("others", marks=pytest.mark.slow)])
def test_matlab_code_predicts_what_pytorch_predicts(which, parts, covering, bundle_of, octave, tmp_path):
    structures = covering if which == "covering" else [name for name in parts[0] if name not in covering]
    found = natives(structures, bundle_of, octave, tmp_path)
    assert set(found) == set(structures)
    for structure, (shares, status) in found.items():
        assert shares.shape[0] == TICKS, structure
        assert shares.max() < 1, structure
        assert status.tolist() == [1] * 8 + [0] * (TICKS - 8), structure


@pytest.mark.slow
@pytest.mark.parametrize("network", ["hybrid+all", "tcn+all", "gru+quantiles", "lstm2", "lstm+hybrid physics"])
def test_matlab_code_follows_pytorch_for_a_long_time(network, matlab_folder_of, bundle_of, octave, tmp_path):
    predictor = bundle_of(network).predictor
    inputs = random_inputs(predictor, 2_000, seed=8)
    scipy.io.savemat(tmp_path / "rows.mat", {"rows": inputs})
    program = "load('rows.mat'); found = arm_stream(arm_load(), rows); save('-v6', 'found.mat', 'found');"
    octave(f"addpath('{matlab_folder_of(network)}'); {program}", tmp_path)
    found, wanted = scipy.io.loadmat(tmp_path / "found.mat")["found"], stream(predictor, inputs)
    assert (np.abs(found - wanted) <= tolerance(predictor, inputs, wanted)).all()


def test_names_of_matlab_are_their_own():
    names = matlab_names(["a b", "a-b", "2x", "_y", "x" * 80, "x" * 81])
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[A-Za-z]\w{0,62}", name) for name in names)


def test_only_functions_that_are_called_are_written():
    found = re.findall(r"^function .*?(\w+)\(", functions_for("y = lstm(x); z = tanh(y);"), re.MULTILINE)
    assert found == ["lstm", "gated", "mixed", "normed", "sigmoid"]
    text = (Path(native_file.__file__).parent / "templates/layers.m.in").read_text()
    every = functions_for(" ".join(re.findall(r"\w+\(", text)))
    assert every.count("function ") == text.count("function ")


def test_every_file_is_matlab(matlab_folder_of, octave, tmp_path):
    """Of R2021b for a parser of MATLAB, and for Octave's, which parses only what needs MATLAB or Simulink."""
    folders = [matlab_folder_of("hybrid+all", whole) for whole in (False, True)]
    files = [file for folder in folders for file in sorted(folder.glob("*.m"))]
    assert len(files) == 13 + 9
    octave("\n".join(f"__parse_file__('{file}');" for file in files), tmp_path)
    parser = Path(sys.executable).with_name("mh_style")
    if not parser.exists():
        pytest.skip("needs the package miss-hit-core: the extra dev has it")
    for folder in folders:
        command = [parser, "--ignore-config", "--no-style", "--matlab", "2021b", "--single", folder]
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


def test_names_widths_rates_and_states_of_others_are_refused(octave, matlab_folder_of, bundle_of, tmp_path):
    folder, task = matlab_folder_of("hybrid"), bundle_of("hybrid").task
    names, rate = task.inputs, task.rate_hz
    cells = ", ".join(f"'{name}'" for name in names)
    program = f"""
addpath('{folder}'); net = arm_load();
function say(f)
    try f(); disp('taken'); catch problem, disp([problem.identifier, ' ', problem.message]); end
end
names = {{{cells}}};
say(@() arm_names(net, names));
say(@() arm_names(net, names([2 1 3:end])));
say(@() arm_names(net, names(2:end)));
say(@() arm_names(net, [names, {{'more'}}]));
say(@() arm_names(net, [names, names(2)]));
s = arm_reset(net);
say(@() arm_step(net, zeros({len(names) - 1}, 1), s));
say(@() arm_step(net, 'text', s));
say(@() arm_step(net, [], s, 1.5));
say(@() arm_stream(net, zeros(3, {len(names) + 1})));
recording = struct();
for at = numel(names):-1:1, recording.(names{{at}}) = (1:4)' + 10 * at; end
recording.other = 1;
rows = arm_rows(net, recording); disp(rows(2, :) - 10 * (1:numel(names)));
say(@() arm_rows(net, rmfield(recording, names{{2}})));
recording.time = 5 + (0:3)' / {rate}; disp(size(arm_rows(net, recording)));
recording.time = (0:3)' / {rate} * 2;
say(@() arm_rows(net, recording));
recording = rmfield(recording, 'time');
recording.(names{{3}}) = 1;
say(@() arm_rows(net, recording));
[out, status] = arm_step(net, zeros({len(names)}, 1), []); disp([status, out.prediction(1)]);
s.marker = 'another'; [out, status] = arm_step(net, zeros({len(names)}, 1), s); disp([status, out.prediction(1)]);
say(@() arm_golden('strange'));
"""
    said = octave(program, tmp_path).splitlines()
    assert said[0] == "taken"
    assert said[1].startswith(f"edp:names arm: signal 1 is {names[1]}, but it must be {names[0]}")
    assert said[2].startswith(f"edp:names arm: missing: {names[0]}; it reads: {names[0]}, ")
    assert said[3].endswith("leave out: more")
    assert said.pop(4).endswith(f"leave out: {names[1]}")
    assert [line.split()[0] for line in said[4:8]] == ["edp:width", "edp:width", "edp:missed", "edp:width"]
    assert said[8].split() == ["2"] * len(names)
    assert said[9].startswith(f"edp:names arm: missing: {names[1]} (")
    assert said.pop(10).split() == ["4", str(len(names))]
    assert said.pop(10) == "edp:rate arm: rows 1 and 2 are 0.02 s apart; the network wants 0.01 s: resample first"
    assert said[10].startswith("edp:length arm: ")
    assert [line.split() for line in said[11:13]] == [["4", "NaN"]] * 2
    assert said[13].startswith("edp:form arm_golden: no form strange; there are native, octave, sfun, onnx")


@pytest.mark.parametrize("network", ["hybrid9", "tcn+quantiles"])
def test_matlab_code_and_the_s_function_in_octave_keep_the_same_rules(
    network, c, octave, hard_rows, matlab_folder_of, bundle_of, tmp_path
):
    """The S-function as a MEX: same statuses and counts, numbers within what is allowed, golden recording too."""
    c.need("gcc", "mkoctfile")
    folder, predictor = matlab_folder_of(network), bundle_of(network).predictor
    rows = hard_rows(predictor)
    scipy.io.savemat(tmp_path / "rows.mat", {"rows": rows})
    program = f"""
addpath('{folder}'); net = arm_load(); load('rows.mat');
arm_golden('native'); arm_golden('octave');
[found, status, counts] = arm_octave(rows);
late = (0:size(rows, 1) - 1)' / {predictor.task.rate_hz};
late(70:end) += 3 / {predictor.task.rate_hz}; late(80:end) += 1;
[found2, status2, counts2] = arm_octave(rows, late);
s = arm_reset(net); numbers = []; said = []; counted = [];
s2 = s; numbers2 = []; said2 = []; counted2 = [];
for tick = 1:size(rows, 1)
    [out, said(tick, 1), s] = arm_step(net, rows(tick, :), s);
    parts = cellfun(@(x) reshape(x.', 1, []), struct2cell(out), 'UniformOutput', false);
    numbers(tick, :) = [parts{{:}}];
    counted(tick, :) = [s.ticks, s.rejected, s.held, s.restarts];
    if tick == 70, [~, ~, s2] = arm_step(net, [], s2, 3); end
    if tick == 80, [~, ~, s2] = arm_step(net, [], s2, {predictor.task.rate_hz:g}); end
    [out, said2(tick, 1), s2] = arm_step(net, rows(tick, :), s2);
    parts = cellfun(@(x) reshape(x.', 1, []), struct2cell(out), 'UniformOutput', false);
    numbers2(tick, :) = [parts{{:}}];
    counted2(tick, :) = [s2.ticks, s2.rejected, s2.held, s2.restarts];
end
save('-v6', 'found.mat');
"""
    printed = octave(program, tmp_path)
    assert printed.count("of what is allowed, over 200 ticks") == 2
    found = scipy.io.loadmat(tmp_path / "found.mat")
    allowed = 2 * tolerance(predictor, rows[:20].astype(np.float32), stream(predictor, rows[:20].astype(np.float32)))
    for two in ("", "2"):
        np.testing.assert_array_equal(found[f"status{two}"], found[f"said{two}"])
        np.testing.assert_array_equal(found[f"counts{two}"], found[f"counted{two}"])
        np.testing.assert_array_equal(np.isnan(found[f"found{two}"]), np.isnan(found[f"numbers{two}"]))
        np.testing.assert_array_equal(np.isnan(found[f"found{two}"]).all(axis=1), found[f"status{two}"].ravel() >= 3)
        assert (np.abs(np.nan_to_num(found[f"found{two}"] - found[f"numbers{two}"])) <= 100 * allowed).all()
    status = found["status"].ravel()
    assert set(status) == {0, 1, 2, 3}
    assert (status[40:49] == [2] * 5 + [3] * 4).all()
    assert found["status2"].ravel()[78:81].tolist() == [0, 1, 1]
    assert found["counts2"][-1].tolist() == [90 + 3 + predictor.task.rate_hz, 12, 5 + 3 + 3, 2]
