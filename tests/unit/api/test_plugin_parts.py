"""Parts of a user's package: found by entry point and by ``EDP_PLUGINS``, recorded, named where they are missing."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from edp.errors import ConfigError
from edp.networks.blocks import BLOCKS
from edp.registry import _PLUGINS, Registry, load_plugins, missing_parts, origins_in
from edp.storage.seals import HASH, content_digest

BLOCK = """
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import nn

from edp.ir.layers import ScaleShift
from edp.networks.blocks.base import BLOCKS, BlockSlot
from edp.networks.streaming import Cost, Streaming


class Gain(Streaming):
    def __init__(self, width):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(width))

    def initial_state(self, batch, like):
        return ()

    def forward(self, x, state):
        return x * self.weight, ()

    def costs(self):
        width = len(self.weight)
        return [Cost("gain", width, width_in=width, width_out=width)]

    def lower(self, build, x):
        return build.add(ScaleShift, "gain", x, gain=self.weight, shift=torch.zeros_like(self.weight))


@BLOCKS.register("bar_gain")
@dataclass(frozen=True)
class GainBlock:
    slot: ClassVar[BlockSlot] = BlockSlot.CHANNELS
    space: ClassVar[dict[str, object]] = {}

    def build(self, width, window):
        return Gain(width)
"""
FORMAT = """
import numpy as np

from edp.logs.formats.base import FORMATS, RawLog, RawSignal


class BarFormat:
    name, suffixes, content, parts = "bar", (".bar",), "a table of bars", False

    def claims(self, head):
        return head.startswith(b"BAR1")

    def read(self, path, signal_map):
        rows = np.loadtxt(path, skiprows=2, ndmin=2)
        names = path.read_text().splitlines()[1].split()
        signals = {
            name: RawSignal(name, lambda i=i: rows[:, i], len(rows), time=rows[:, 0])
            for i, name in enumerate(names)
            if i
        }
        return RawLog(path, signals)

    def write(self, recording, path):
        raise NotImplementedError
"""
REGISTERS = """from barpkg.bars import BarFormat
from edp.logs.formats.base import FORMATS

FORMATS.register("bar")(BarFormat())
"""


@pytest.fixture
def site(tmp_path):
    """A folder with an installed package whose entry points are plug-ins."""
    package = tmp_path / "site" / "barpkg"
    package.mkdir(parents=True)
    (package / "__init__.py").touch()
    (package / "blocks.py").write_text(BLOCK)
    (package / "bars.py").write_text(FORMAT)
    (package / "logs.py").write_text(REGISTERS)
    info = tmp_path / "site" / "bar_plugin-1.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: bar-plugin\nVersion: 1.2\n")
    (info / "top_level.txt").write_text("barpkg\n")
    (info / "RECORD").write_text("barpkg/__init__.py,,\n")
    (info / "entry_points.txt").write_text("[edp.plugins]\nblocks = barpkg.blocks\nlogs = barpkg.logs\n")
    return tmp_path / "site"


def call(*words, site=None, plugins="", code=None):
    """Run ``edp``, or Python code, in a process of its own."""
    env = {key: value for key, value in os.environ.items() if key not in ("EDP_PLUGINS", "PYTHONPATH")}
    env |= {"PYTHONPATH": str(site)} if site else {}
    env |= {"EDP_PLUGINS": plugins} if plugins else {}
    run = ["-c", code] if code else ["-c", "from edp.cli import main; main()", *map(str, words)]
    return subprocess.run([sys.executable, *run], env=env, capture_output=True, text=True, timeout=300, check=False)


def small(tmp_path):
    data = tmp_path / "logs"
    data.mkdir(exist_ok=True)
    for number in range(3):
        rows = [
            f"{0.01 * i:.2f},{(i // 40 + number) % 3 - 1},{((i // 40 + number) % 3 - 1) * 0.1 + i % 7 / 500}"
            for i in range(600)
        ]
        (data / f"log_{number}.csv").write_text("\n".join(["time,lever,speed", *rows]) + "\n")
    (tmp_path / "map.toml").write_text('time = "time"\n[channels]\nlever = "lever"\nspeed = "speed"\n')
    (tmp_path / "settings.toml").write_text(
        '[task]\ntargets = ["speed"]\nhorizons = [2]\nfeatures = {channels = ["lever", "speed"]}\n'
        '[model]\nblocks = [{kind = "bar_gain"}]\n'
        'window = 12\nbackbone = {kind = "hybrid", channels = [6], kernel = 3, units = 6}\n'
        '[training]\nepochs = 1\nupdates = 2\nchunks = {regime = "chunk", length = 32, batch = 4, burn_in = 10}\n'
    )
    mapped = ("--map", tmp_path / "map.toml")
    return ("train", data, *mapped, "--config", tmp_path / "settings.toml", "--preset", "quick")


@pytest.mark.timeout(600)
def test_a_block_of_a_package_trains_and_its_run_says_where_the_block_came_from(site, tmp_path):
    trained = call(*small(tmp_path), "--out", tmp_path / "run", site=site)
    assert trained.returncode == 0, trained.stderr
    header = json.loads((tmp_path / "run/bundle/bundle.json").read_text())
    entry = {"what": "block", "part": "bar_gain", "module": "barpkg.blocks", "package": "bar-plugin", "version": "1.2"}
    assert header["plugins"] == [entry]
    loads = f"import edp; print(edp.load({str(tmp_path / 'run')!r}).targets)"
    assert call(code=loads, site=site).stdout == "('speed',)\n"
    ended = call("evaluate", tmp_path / "run")
    assert "block 'bar_gain': not registered; it came from package 'bar-plugin' 1.2 (module barpkg.blocks); " in (
        ended.stderr
    )
    assert "pip install bar-plugin, or set EDP_PLUGINS=barpkg.blocks" in ended.stderr
    assert "damaged" not in ended.stderr
    assert ended.returncode == 1


@pytest.mark.timeout(600)
def test_a_module_that_edp_plugins_names_is_enough(site, tmp_path):
    (site / "bar_plugin-1.2.dist-info/entry_points.txt").unlink()
    refused = call(*small(tmp_path), "--out", tmp_path / "run", site=site)
    assert "unknown block 'bar_gain'" in refused.stderr
    assert "a part of your own package needs EDP_PLUGINS=MODULE or an entry point 'edp.plugins'" in refused.stderr
    trained = call(*small(tmp_path), "--out", tmp_path / "run", site=site, plugins="barpkg.blocks")
    assert trained.returncode == 0, trained.stderr


def test_a_log_format_of_a_package_is_read_in_the_sandbox(site, tmp_path):
    rows = "\n".join(f"{0.01 * i:.2f} {i % 9} {i % 5}" for i in range(500))
    (tmp_path / "log.bar").write_text(f"BAR1\ntime lever speed\n{rows}\n")
    (tmp_path / "map.toml").write_text('[channels]\nlever = "lever"\nspeed = "speed"\n')
    shown = call("inspect", tmp_path / "log.bar", "--map", tmp_path / "map.toml", site=site)
    assert shown.returncode == 0, shown.stderr
    assert "500" in shown.stdout


def test_a_plugin_that_fails_is_left_out_with_one_warning(site, tmp_path):
    (site / "barpkg/blocks.py").write_text(BLOCK + "\nraise RuntimeError('no licence')\n")
    shown = call("runs", tmp_path, site=site)
    assert shown.returncode == 0
    where = "plug-in 'blocks' of package 'bar-plugin' 1.2 cannot be loaded and is left out: RuntimeError: no licence"
    assert shown.stderr.count(where) == 1
    missing = call("runs", tmp_path, plugins="nowhere_to_be_found")
    assert missing.returncode == 0
    assert "plug-in 'nowhere_to_be_found' of EDP_PLUGINS cannot be loaded" in missing.stderr


def test_two_parts_of_one_name_are_told_apart(site, tmp_path):
    (site / "barpkg/blocks.py").write_text(BLOCK.replace('"bar_gain"', '"linear_bypass"'))
    shown = call("runs", tmp_path, site=site)
    assert "block 'linear_bypass' is registered twice, first by EDP; choose another name" in shown.stderr


def test_without_plugins_nothing_is_recorded_and_importing_edp_looks_for_none():
    assert origins_in({"model": {"blocks": [{"kind": "linear_bypass"}]}}) == []
    looked = call(code="import edp, sys; print('edp.registry' in sys.modules, 'importlib.metadata' in sys.modules)")
    assert looked.stdout == "False False\n"


@pytest.fixture
def foreign(monkeypatch):
    """A registry with a part that a module of a test registered."""
    registry: Registry[type] = Registry("gadget")
    registry.register("own")(Path)
    monkeypatch.setattr(_PLUGINS, "recorded", {})
    return registry


def test_texts_of_a_file_are_shown_and_never_imported(foreign, monkeypatch):
    hostile = {"what": "gadget", "part": "x\x1b[2J", "module": "os.system\n" + "y" * 500, "package": "", "version": ""}
    before = set(sys.modules)
    (sentence,) = missing_parts([hostile, {"what": 3}, "text", None], {"kind": "x\x1b[2J"})
    assert set(sys.modules) == before
    assert sentence.isprintable()
    assert len(sentence) < 400
    assert missing_parts(7, {}) == []
    assert missing_parts([hostile], {"kind": "own"}) == []


def test_a_recorded_part_is_named_by_a_later_message_on_settings(foreign):
    entry = {"what": "gadget", "part": "spring", "module": "bar.parts", "package": "bar", "version": "3"}
    missing_parts([entry], {})
    with pytest.raises(
        ConfigError, match=r"unknown gadget 'spring'.*package 'bar' 3 \(module bar.parts\).*pip install bar"
    ):
        foreign["spring"]


def test_every_registry_is_known_to_plugins():
    assert BLOCKS in _PLUGINS.registries
    assert load_plugins() == []


def test_a_bundle_of_before_with_an_unknown_part_is_not_called_damaged(edp_bundle):
    header = json.loads((edp_bundle / "bundle.json").read_text())
    header["model"]["blocks"] = [{"kind": "bar_gain"}]
    (edp_bundle / "bundle.json").write_text(json.dumps(header | {HASH: content_digest(header)}))
    import edp

    with pytest.raises(edp.EdpError, match="unknown block 'bar_gain'") as refused:
        edp.load(edp_bundle)
    assert "damaged" not in str(refused.value)


@pytest.fixture
def edp_bundle(tmp_path):
    import numpy as np

    import edp

    rng = np.random.default_rng(0)
    data = edp.Recordings.from_arrays(rng.normal(size=(4, 400, 2)), rate_hz=100, names=["lever", "speed"])
    settings = {"training.epochs": 1, "training.updates": 1}
    edp.train(data, targets=["speed"], horizons=[1], preset="small", settings=settings, out=tmp_path / "run")
    return tmp_path / "run/bundle"
