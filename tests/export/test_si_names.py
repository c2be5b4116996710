"""Exported forms hold SI values: no name states another unit."""

import re
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

import edp
from edp.cli import app
from edp.export import TARGETS
from edp.export import si_names as module
from edp.export.si_names import si_channels, si_names
from edp.signals import KINDS, UNIT_ENDINGS, UNIT_TAILS, UNITS, Channel, Kind

KINDS_WITH_UNITS = [kind for kind in Kind if kind is not Kind.GENERIC]


@pytest.mark.parametrize(
    ("name", "kind", "expected"),
    [
        ("Weg_Hub_mm", Kind.POSITION, "Weg_Hub_m"),
        ("pA_bar", Kind.PRESSURE, "pA_Pa"),
        ("pA_Pa", Kind.PRESSURE, "pA_Pa"),
        ("p [bar]", Kind.PRESSURE, "p [Pa]"),
        ("Druck (bar)", Kind.PRESSURE, "Druck (Pa)"),
        ("v_mm_s", Kind.VELOCITY, "v_m_s"),
        ("v mmps", Kind.VELOCITY, "v m_s"),
        ("v_m_s", Kind.VELOCITY, "v_m_s"),
        ("a.mm_s2", Kind.ACCELERATION, "a.mm_s2"),
        ("a_mm_s2", Kind.ACCELERATION, "a_m_s2"),
        ("Q_l_min", Kind.FLOW, "Q_m3_s"),
        ("valve_percent", Kind.RATIO, "valve"),
        ("lever [%]", Kind.RATIO, "lever"),
        ("oil_degC", Kind.TEMPERATURE, "oil_K"),
        ("count_mm", Kind.GENERIC, "count_mm"),
        ("p_A", Kind.PRESSURE, "p_A"),
        ("mm", Kind.POSITION, "mm"),
        ("CylVels_1", Kind.VELOCITY, "CylVels_1"),
        ("crossbar", Kind.FORCE, "crossbar"),
    ],
)
def test_a_unit_at_the_end_of_a_name_is_the_si_unit(name, kind, expected):
    assert si_names([name], [kind]) == [expected]


ENDINGS = sorted({f"_{end}" for end in (*UNIT_ENDINGS, *UNIT_TAILS)} | {f" [{unit}]" for unit in UNITS})
NAMES = st.lists(
    st.tuples(st.sampled_from(["p", "Weg_Hub", "x1"]), st.sampled_from(["", *ENDINGS]), st.sampled_from([*Kind])),
    unique_by=lambda entry: entry[0] + entry[1],
    max_size=12,
)


@given(NAMES)
def test_names_stay_different_and_a_second_pass_changes_nothing(parts):
    names, kinds = [a + b for a, b, _ in parts], [kind for _, _, kind in parts]
    once = si_names(names, kinds)
    assert len(set(once)) == len(names)
    assert si_names(once, kinds) == once
    for name, new, kind in zip(names, once, kinds, strict=True):
        found = None if kind is Kind.GENERIC else module._unit_at_end(new)
        assert found is None or found[2] == KINDS[kind].si_unit, (name, new)


def test_a_name_that_stays_is_never_given_to_another():
    assert si_names(["x_mm", "x_m", "x_cm"], [Kind.POSITION] * 3) == ["x_m_1", "x_m", "x_m_2"]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    rng = np.random.default_rng(0)
    lever = np.repeat(rng.uniform(-1, 1, 80), 10)
    stroke = 100 + 50 * np.cumsum(lever) / len(lever)
    arrays = np.stack([lever, 50 + lever, stroke], axis=1)
    data = edp.Recordings.from_arrays(
        [arrays, arrays[::-1], arrays],
        rate_hz=100,
        names=["lever", "p_Hub_bar", "Weg_Hub_mm"],
        units=["%", "bar", "mm"],
    )
    folder = tmp_path_factory.mktemp("si") / "run"
    settings = {
        "model.backbone": {"kind": "hybrid", "channels": [4], "kernel": 3, "units": 4},
        "model.head": {"kind": "mlp", "hidden": 4},
        "model.blocks": [],
        "model.window": 12,
        "training.epochs": 1,
    }
    edp.train(data, targets=["Weg_Hub_mm"], horizons=[1], out=folder, preset="quick", settings=settings)
    return folder


def _texts(path):
    """Content of a file; of a zip file those in it."""
    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            return [archive.read(name).decode("utf-8", "replace") for name in archive.namelist()]
    return [path.read_text(encoding="utf-8", errors="replace")]


@pytest.mark.parametrize("target", sorted(TARGETS))
def test_no_exported_text_joins_a_name_of_another_unit_with_an_si_value(run, target, tmp_path):
    options = ["--set", "binaries=none"] if target == "fmu" else []  # its sources hold the names
    words = ["export", str(run), "--to", target, *options, "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(app, words)
    assert result.exit_code == 0, (result.output, result.exception)
    texts = [
        text
        for path in (tmp_path / "out").rglob("*")
        if path.is_file() and path.suffix != ".mat"
        for text in _texts(path)
    ]
    joined = re.sub(r'"original":\s*"[^"]*"', "", "\n".join(texts))
    assert "Weg_Hub_m" in joined
    assert "Weg_Hub_mm" not in joined
    assert "p_Hub_bar" not in joined


def test_channels_keep_all_but_their_name():
    assert si_channels([Channel("x_mm", Kind.POSITION, "d")]) == [Channel("x_m", Kind.POSITION, "d")]
