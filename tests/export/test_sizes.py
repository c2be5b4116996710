"""Bytes that are stated before anything is compiled, against the compiled objects: constants and program."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import torch

from edp.errors import ExportError
from edp.evaluation.controller import Budget
from edp.evaluation.footprint import footprint
from edp.export.c.constants import DESKTOP
from edp.export.c.model import make_model
from edp.export.c.program import runtime_bytes
from edp.export.c.sizes import constant_bytes, program_bytes, sizes_of
from edp.export.c.target import core_files
from edp.ir.rls import Adaptation, AdaptationSpec
from edp.ir.w8a16.quantise import outline
from edp.networks.input_range import usual_range
from edp.workflows.compression.formats import FORMATS, resource_usage

ARM = ("-std=c99", "-O2", "-ffp-contract=off", "-mthumb", "-mcpu=cortex-m4", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16",
       "-ffunction-sections", "-fdata-sections")  # fmt: skip
HERE = ("-std=c99", "-O2", "-ffp-contract=off")
LINK = ("-nostartfiles", "--specs=nosys.specs", "-Wl,--gc-sections", "-Wl,-e,main")
SECTION = re.compile(r"^\s*\[\s*\d+\]\s+(\S+)\s+PROGBITS\s+\S+\s+\S+\s+([0-9a-f]+)", re.M)
MAIN = """
#include "predictor.h"
static predictor_state state;
static predictor_output out;
static float in[PREDICTOR_INPUTS];
{more}
int main(void) {{
    predictor_reset(&state);
    (void)predictor_step(&state, in, &out);
    (void)predictor_missed(&state, 2u, &out);
    {adapt}
    return predictor_check() ? 0 : 1;
}}
"""
ADAPTED = """#include "predictor_adaptation.h"
static predictor_adaptation adaptation;
static predictor_learned learned;"""
ADAPT = """predictor_adapt_reset(&adaptation);
    (void)predictor_adapt(&adaptation, &state, true, &out, &out);
    predictor_adapt_get(&adaptation, &learned);
    (void)predictor_adapt_set(&adaptation, &learned);"""


def words(size: int) -> int:
    return -(-size // 4) * 4


class Compiled:
    """Compiles exported models; the runtime once for all of them."""

    def __init__(self, c, folder: Path) -> None:
        self.c, self.folder = c, folder

    def write(self, bundle, adapts: bool, folder: Path):
        model = make_model("predictor", bundle, adapts=adapts)
        for name, text in core_files(model).items():
            (folder / name).write_text(text)
        return model

    def runtime(self, model, folder: Path) -> list[Path]:
        """Its objects for the controller."""
        kept = self.folder / ("whole" if model.integer else "float")
        if not kept.exists():
            kept.mkdir()
            sources = [folder / name for name in model.runtime if name.endswith(".c") and "adaptation" not in name]
            self.c.run("arm-none-eabi-gcc", *ARM, "-c", *sources, folder=kept)
        return sorted(kept.glob("*.o"))

    def sections(self, path: Path, kinds: str) -> int:
        """Bytes of a file's sections, each up to the next word."""
        held = SECTION.findall(self.c.run("arm-none-eabi-readelf", "-SW", path).decode())
        return sum(words(int(size, 16)) for name, size in held if re.fullmatch(kinds, name))

    def on_controller(self, bundle, folder: Path, adapts: bool = False) -> tuple[int, int]:
        """Constants and program of a linked model."""
        self.c.need("arm-none-eabi-gcc")
        model = self.write(bundle, adapts, folder)
        more, adapt = (ADAPTED, ADAPT) if adapts else ("", "")
        (folder / "main.c").write_text(MAIN.format(more=more, adapt=adapt))
        own = ["predictor.c", *(["predictor_adaptation.c", "edp_adaptation.c"] if adapts else [])]
        self.c.run("arm-none-eabi-gcc", *ARM, "-c", "main.c", *own, folder=folder)
        objects = [folder / name.replace(".c", ".o") for name in ("main.c", *own)]
        flags = (*ARM, *LINK, *objects, *self.runtime(model, folder), "-lm", "-o", "image.elf")
        self.c.run("arm-none-eabi-gcc", *flags, folder=folder)
        held = [path for path in objects if path.name.startswith("predictor")]
        constants = sum(self.sections(path, r"\.(rodata|data).*") for path in held)
        image = self.sections(folder / "image.elf", r"\.(text|rodata)")
        return constants, image - self.sections(folder / "main.o", r"\.text.*") - constants

    def on_desktop(self, bundle, folder: Path, adapts: bool = False) -> int:
        """Constants of an object of this computer, without the gaps between them."""
        self.c.need("gcc")
        if shutil.which("nm") is None:
            pytest.skip("needs the Debian package binutils")
        self.write(bundle, adapts, folder)
        own = ["predictor.c", *(["predictor_adaptation.c"] if adapts else [])]
        self.c.run("gcc", *HERE, "-c", *own, folder=folder)
        total = 0
        for name in own:
            for line in self.c.run("nm", "-S", name.replace(".c", ".o"), folder=folder).decode().splitlines():
                words_of = line.split()
                if len(words_of) == 4 and words_of[2] in "rRdD":
                    total += int(words_of[1], 16)
        return total


@pytest.fixture(scope="module")
def compiled(c, tmp_path_factory):
    return Compiled(c, tmp_path_factory.mktemp("runtimes"))


def adapted(bundle, rank):
    """The bundle with an adaptation."""
    task = bundle.task
    centre, spread = usual_range(bundle.predictor)
    columns = tuple(task.inputs.index(name) for name in task.targets)
    shape = (len(task.horizons), len(task.targets))
    arrays = {
        "offset": centre, "scale": spread, "directions": np.ones((rank, len(centre))),
        "middle": centre[list(columns)], "spread": spread[list(columns)],
        "change": np.full(shape, 0.7), "unit": np.full(shape, 0.4),
    }  # fmt: skip
    held = {name: np.asarray(values, dtype=np.float32) for name, values in arrays.items()}
    spec = AdaptationSpec(rank=rank)
    law = Adaptation(spec=spec, rate_hz=task.rate_hz, horizons=task.horizons, columns=columns, **held)
    return replace(bundle, adaptation=law)


def stated(bundle, name, adaptation=None):
    """What `edp compress estimate` says of the float network in a format."""
    predictor = bundle.predictor
    return footprint(predictor if name == "float32" else predictor.to_float_network(), adaptation).estimate(name)


@pytest.mark.covering
@pytest.mark.parametrize("name", ["float32", "w8a16"])
def test_constants_are_those_of_the_object_and_the_program_is_met(structure, name, bundle_of, compiled, tmp_path):
    bundle = bundle_of(structure, name == "w8a16")
    constants, program = compiled.on_controller(bundle, tmp_path)
    said = stated(bundle, name)
    assert said.parameter_bytes == constants
    assert said.program_bytes == pytest.approx(program, rel=0.02)
    assert said.flash_bytes == said.parameter_bytes + said.program_bytes
    assert f"Constants {constants} bytes" in (tmp_path / "predictor.h").read_text()


@pytest.mark.covering
@pytest.mark.parametrize("name", ["float32", "w8a16"])
def test_constants_are_those_of_the_object_on_this_computer(structure, name, bundle_of, compiled, tmp_path):
    bundle = bundle_of(structure, name == "w8a16")
    graph = bundle.predictor.integers if name == "w8a16" else bundle.predictor.graph()
    assert constant_bytes(graph, machine=DESKTOP) == compiled.on_desktop(bundle, tmp_path)


@pytest.mark.parametrize("rank", [0, 3])
@pytest.mark.parametrize(("network", "whole"), [("hybrid", False), ("lstm+quantiles", False), ("gru", True)])
def test_an_adaptation_is_counted(network, whole, rank, bundle_of, compiled, tmp_path):
    bundle = adapted(bundle_of(network, whole), rank)
    constants, program = compiled.on_controller(bundle, tmp_path, adapts=True)
    said = stated(bundle, "w8a16" if whole else "float32", bundle.adaptation)
    assert said.parameter_bytes == constants
    assert said.program_bytes == pytest.approx(program, rel=0.02)
    (tmp_path / "here").mkdir()
    graph = bundle.predictor.integers if whole else bundle.predictor.graph()
    here = compiled.on_desktop(bundle, tmp_path / "here", adapts=True)
    assert constant_bytes(graph, bundle.adaptation, DESKTOP) == here


@pytest.mark.covering
def test_a_network_in_whole_numbers_is_counted_before_it_is_one(structure, predictor_of, integers_of):
    """Neither recordings nor weights change what it takes."""
    integers = integers_of(structure)
    assert sizes_of(outline(predictor_of(structure, dtype=torch.float32).graph())) == sizes_of(integers.integers)


def test_every_figure_of_a_network_is_the_same(predictor_of, integers_of):
    predictor = predictor_of("hybrid", dtype=torch.float32)
    counts, integers = footprint(predictor), integers_of("hybrid").integers
    for name, graph in (("float32", predictor.graph()), ("w8a16", integers)):
        said = resource_usage(predictor, name, Budget())
        entry = counts.estimate(name)
        rows = {row.what: row.value for row in counts.verdict(Budget())}
        assert said.parameter_bytes == entry.parameter_bytes == rows[f"parameters, {name}"] == constant_bytes(graph)
        assert said.flash_bytes == entry.flash_bytes == rows[f"flash, {name}"]
        assert said.ram_bytes == rows[f"RAM, {name}"]
        assert entry.program_bytes == program_bytes(graph)
    assert set(FORMATS) >= {"float32", "w8a16"}


def test_a_network_without_a_form_in_whole_numbers_has_no_figures_for_it(predictor_of):
    predictor = predictor_of("hybrid+all", dtype=torch.float32)
    refused = footprint(predictor_of("lstm2", dtype=torch.float32))
    assert [entry.number_format for entry in footprint(predictor).estimates] == ["float32", "w8a16"]
    assert [entry.number_format for entry in refused.estimates] == ["float32"]
    assert "no form in integer arithmetic" in refused.refused["w8a16"]
    with pytest.raises(ExportError, match="no form in integer arithmetic"):
        refused.estimate("w8a16")
    assert not any("w8a16" in row.what for row in refused.verdict(Budget()))


def test_sizes_are_known_of_every_function_of_the_runtime():
    """Measured anew with ``python benchmarks/program_bytes.py --fit`` when the runtime changes."""
    folder = Path(str(resources.files("edp.export.c") / "runtime"))
    declared = set()
    for path in folder.glob("*.h"):
        if "tangent" not in path.name:
            declared |= set(re.findall(r"^\w[\w ]*?[ *](edp_\w+)\(", path.read_text(), re.M))
    assert len(declared) > 80
    assert all(runtime_bytes([name]) > 0 for name in declared)
