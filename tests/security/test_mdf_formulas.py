"""MDF files whose conversion formulas are code, endless powers or nonsense; and those that are formulas."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numexpr
import numpy as np
import pytest
from asammdf import MDF, Signal
from asammdf.blocks import v4_blocks
from asammdf.blocks.conversion_utils import from_dict

from edp.errors import DataError
from edp.logs import FORMATS, inspect_log, read_recording
from edp.logs.formats.mdf_formula import DEEPEST, FUNCTIONS, LONGEST, Formula, FormulaError
from edp.signals import ChannelMap, SignalMap

CODE = "X1*0.001+0*len(repr(__import__('pathlib').Path('x').touch()))"
TOWER = "X1+9**9**9**9"
BM_UP = SignalMap((ChannelMap("BmUp", "BmUp"),))


def log_with(path: Path, conversion: object, name: str = "BmUp", master: object = None, raw: object = None) -> Path:
    raw = np.arange(100.0) if raw is None else raw
    time = np.arange(len(raw)) / 100
    with MDF(version="4.10") as log:
        signals = [Signal(raw, time, name=name, conversion=conversion), Signal(time, time, name="CylVels_1")]
        log.append(signals, acq_name="Bus", common_timebase=True)
        if master is not None:
            log.groups[0].channels[0].conversion = master
        log.save(path, overwrite=True)
    return path


def hostile_formulas() -> list[str]:
    return [
        CODE,
        TOWER,
        "9**9**9**9",
        "X1+9^9^9^9",
        "__import__('os').system('touch x')",
        "X.__class__",
        "(lambda: 1)()",
        "[c for c in ().__class__.__base__.__subclasses__()]",
        "X1+x1.real",
        "open('x','w')",
        "'a'",
        "X1 if 1 else 2",
        "X;X",
        "X\nX",
        "where(X>1,1,2)",
        "X2",
        "1e",
        "",
        "((X)",
        "X)",
        "sin X",
        "pow(X)",
        "sin(X,X)",
        "5 X",
        "0x10",
        "1_000",
        "X1\0",
        "ⅹ1",
        "(" * 5000 + "X" + ")" * 5000,
        "-" * 5000 + "X",
        "2^" + "-" * 3000 + "X",
        "+".join(["X"] * 3000),
        "sin(" * 100 + "X" + ")" * 100,
    ]


@pytest.mark.parametrize("formula", hostile_formulas(), ids=lambda formula: repr(formula[:24]))
def test_what_is_no_formula_is_refused(formula):
    with pytest.raises(FormulaError):
        Formula.parse(formula)


@pytest.mark.parametrize("formula", [CODE, TOWER, "exp(__import__('pathlib').Path('x').touch() or X)"])
@pytest.mark.parametrize("where", ["channel", "master", "table", "default"])
def test_a_formula_that_is_code_is_never_run(tmp_path, monkeypatch, formula, where):
    monkeypatch.chdir(tmp_path)
    code = from_dict({"formula": formula})
    if where == "channel":
        path = log_with(tmp_path / "a.mf4", code)
    elif where == "master":
        path = log_with(tmp_path / "a.mf4", None, master=code)
    else:
        texts = {"val_0": 5.0, "text_0": code if where == "table" else b"five", "default_addr": code}
        path = log_with(tmp_path / "a.mf4", from_dict(texts))
    with pytest.raises(DataError, match=r"a\.mf4', channel '(BmUp|time)': its conversion formula .* cannot be read"):
        read_recording(path, BM_UP)
    assert any("formula" in finding.what for finding in inspect_log(path, BM_UP).findings)
    assert not (tmp_path / "x").exists()


@pytest.mark.parametrize("command", ["inspect", "screen", "train", "animate"])
def test_no_command_runs_it(tmp_path, monkeypatch, edp, command):
    monkeypatch.chdir(tmp_path)
    path = log_with(tmp_path / "a.mf4", from_dict({"formula": CODE}), raw=np.arange(5000.0))
    more = {"train": ["--out", "run"], "animate": ["--out", "a.html"], "screen": ["--out", "s"], "inspect": []}
    ended = edp(command, path, *more[command])
    assert not (tmp_path / "x").exists()
    assert "Traceback" not in ended.said
    # Screening leaves out a channel that cannot be read; this one asks for it by no map.
    assert command == "screen" or ended.code != 0
    assert command in ("screen", "animate") or "formula" in ended.said


def test_the_librarys_engines_are_switched_off(tmp_path):
    path = log_with(tmp_path / "a.mf4", from_dict({"formula": "2*X"}))
    FORMATS["mdf"].read(path, BM_UP)
    for engine in ("evaluate", "lambdify"):
        with pytest.raises(DataError, match="would have been run"):
            getattr(v4_blocks, engine)("1+1")


GOOD = {
    "2*X1+1": lambda x: 2 * x + 1,
    "X*0.001": lambda x: x * 0.001,
    " ( X1 - 32 ) * 5 / 9": lambda x: (x - 32) * 5 / 9,
    "-X^2": lambda x: -(x**2),
    "2**-X": lambda x: 2**-x,
    "(X^2)^0.5": lambda x: x,
    "10-4-3": lambda x: 0 * x + 3,
    "100/10/5": lambda x: 0 * x + 2,
    "-3.5e-2*x1 + .5": lambda x: -3.5e-2 * x + 0.5,
    "EXP(x/100)": lambda x: np.exp(x / 100),
    "pow(X, 3)": lambda x: x**3,
    "sqrt(abs(-X1))": lambda x: np.sqrt(x),
    "ln(X+1)+log10(X+1)": lambda x: np.log(x + 1) + np.log10(x + 1),
    "asin(X/100)*acos(X/100)+arctan(X)": lambda x: np.arcsin(x / 100) * np.arccos(x / 100) + np.arctan(x),
    "+-+X": lambda x: -x,
    "7": lambda x: 0 * x + 7,
}


@pytest.mark.parametrize("formula", GOOD)
def test_formulas_give_their_numbers(formula):
    x = np.arange(1.0, 90.0)
    np.testing.assert_allclose(Formula.parse(formula)(x), GOOD[formula](x), rtol=1e-14, atol=1e-14)
    np.testing.assert_array_equal(Formula.parse(formula)(x.astype(np.uint8)), Formula.parse(formula)(x))


@pytest.mark.parametrize("name", sorted(set(FUNCTIONS) - {"pow", "ln"}))
def test_functions_are_numexprs(name):
    x = np.linspace(0.1, 0.9, 50)
    spelling = {"asin": "arcsin", "acos": "arccos", "atan": "arctan"}.get(name, name)
    expected = numexpr.evaluate(f"2.5*{spelling}(X)-X/3", {"X": x})
    np.testing.assert_allclose(Formula.parse(f"2.5*{name}(X)-X/3")(x), expected, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize("formula", ["9^(9^(9^9))", "pow(9,pow(9,9))", "exp(exp(exp(9)))", "1e999", "9" * 400])
def test_endless_powers_are_infinite_at_once(formula):
    assert np.isinf(Formula.parse(formula)(np.ones(3))).all()


def test_bounds_are_reached_and_not_passed():
    assert Formula.parse("(" * DEEPEST + "X" + ")" * DEEPEST)(np.ones(1)) == 1
    with pytest.raises(FormulaError, match="deep"):
        Formula.parse("(" * (DEEPEST + 1) + "X" + ")" * (DEEPEST + 1))
    assert Formula.parse("X" + " " * (LONGEST - 1))(np.ones(1)) == 1
    with pytest.raises(FormulaError, match="characters"):
        Formula.parse("X" + " " * LONGEST)


def test_a_log_with_formulas_is_read(tmp_path):
    for formula in ("(X1-5)^2/7", "exp(X/50)", "2*x1"):
        path = log_with(tmp_path / "a.mf4", from_dict({"formula": formula}), raw=np.arange(100, dtype=np.uint8))
        read = read_recording(path, BM_UP)
        expected = Formula.parse(formula)(np.arange(100.0))
        np.testing.assert_allclose(read.column("BmUp"), expected, rtol=1e-6)


def conversions() -> dict[str, dict[str, object]]:
    return {
        "linear": {"a": 0.5, "b": 10.0},
        "rational": {"P1": 0.0, "P2": 2.0, "P3": 1.0, "P4": 0.5, "P5": 1.0, "P6": 200.0},
        "interpolated": {"raw_0": 0.0, "phys_0": 1.0, "raw_1": 50.0, "phys_1": 3.0, "interpolation": True},
        "nearest": {"raw_0": 0.0, "phys_0": 1.0, "raw_1": 50.0, "phys_1": 3.0, "interpolation": False},
        "ranges": {
            "lower_0": 5.0,
            "upper_0": 9.0,
            "phys_0": 1.0,
            "lower_1": 10.0,
            "upper_1": 30.0,
            "phys_1": 2.0,
            "default": -1.0,
        },
        "texts": {"val_0": 3.0, "text_0": b"three", "val_1": 4.0, "text_1": b"four", "default_addr": b"none"},
        "texts and a rule": {"val_0": 3.0, "text_0": b"three", "default_addr": from_dict({"a": 2.0, "b": 1.0})},
        "ranges of texts and a rule": {
            "lower_0": 3.0,
            "upper_0": 20.5,
            "text_0": from_dict({"a": 3.0, "b": 1.0}),
            "default_addr": b"none",
        },
    }


LIBRARY = """
import sys, pathlib, numpy, asammdf
for path in pathlib.Path(sys.argv[1]).glob("*.mf4"):
    with asammdf.MDF(path) as log:
        values = log.select(["BmUp"], ignore_value2text_conversions=True)[0].samples
    numpy.save(path.with_suffix(".npy"), values.astype(float))
"""


def test_other_conversions_give_the_librarys_numbers(tmp_path):
    cases = [(kind, dtype) for kind in conversions() for dtype in ("uint8", "int32", "float64")]
    for kind, dtype in cases:
        raw = np.arange(100).astype(dtype)
        log_with(tmp_path / f"{kind} {dtype}.mf4", from_dict(conversions()[kind]), raw=raw)
    # In a process of its own: here the library's engines are switched off.
    subprocess.run([sys.executable, "-c", LIBRARY, str(tmp_path)], check=True)
    for kind, dtype in cases:
        read = read_recording(tmp_path / f"{kind} {dtype}.mf4", BM_UP).column("BmUp")
        expected = np.load(tmp_path / f"{kind} {dtype}.npy")
        if kind == "ranges":
            # The library leaves out integers within a range; ASAM has both ends belong to it.
            x = np.arange(100)
            last = dtype != "float64"
            first = (x >= 5) & (x < 9 + last)
            expected = np.where(first, 1.0, np.where((x >= 10) & (x < 30 + last), 2.0, -1.0))
        np.testing.assert_allclose(read, expected, rtol=1e-6, err_msg=f"{kind} {dtype}")
