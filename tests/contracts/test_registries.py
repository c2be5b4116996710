"""The parts that exist: what is registered, what fits where, and that the contract tests reach all of it."""

from pathlib import Path

import pytest

import edp.networks.blocks
import edp.networks.cells
from edp.data.augment import AUGMENTATIONS
from edp.data.features import DERIVATIONS
from edp.data.splits import SPLITS
from edp.errors import ConfigError, EdpError
from edp.networks.activations import ACTIVATIONS
from edp.networks.backbones import BACKBONES, TcnSpec
from edp.networks.blocks import BLOCKS
from edp.networks.blocks.base import OUTPUT_SLOTS
from edp.networks.cells import CELLS
from edp.networks.heads import HEADS
from edp.networks.initial import INITIAL_STATES
from edp.networks.losses import LOSSES, TERMS
from edp.networks.outputs import OUTPUTS
from edp.networks.physics import PHYSICS
from edp.networks.predictor import ModelSpec
from edp.registry import Registry
from edp.testing.networks import check_space, check_spec
from edp.training.averages import AVERAGES
from edp.training.optimizers import OPTIMIZERS
from edp.training.schedules import SCHEDULES

SPECS = [
    BACKBONES,
    CELLS,
    INITIAL_STATES,
    PHYSICS,
    BLOCKS,
    HEADS,
    ACTIVATIONS,
    OUTPUTS,
    LOSSES,
    TERMS,
    AUGMENTATIONS,
    AVERAGES,
    OPTIMIZERS,
    SCHEDULES,
    SPLITS,
]
ENTRIES = [pytest.param(registry, name, id=f"{registry.what}-{name}") for registry in SPECS for name in registry]


def test_every_backbone_is_tested_with_every_block_that_fits_and_in_every_form(parts):
    structures, forms = parts
    tested = {
        (BACKBONES.name_of(s.backbone), BLOCKS.name_of(s.blocks[0])) for s in structures.values() if len(s.blocks) == 1
    }
    fitting = {
        (backbone, block)
        for backbone in BACKBONES
        for block in BLOCKS
        if BLOCKS[block].slot in {*BACKBONES[backbone]().slots(), *OUTPUT_SLOTS}
    }
    assert tested == fitting
    assert {block for _, block in fitting} == set(BLOCKS)
    assert {backbone for backbone, _ in fitting} == set(BACKBONES)
    assert len(forms) == len(ACTIVATIONS) * 2 * 2
    every = list(structures.values())
    assert {(BACKBONES.name_of(s.backbone), HEADS.name_of(s.head)) for s in every} == {
        (backbone, head) for backbone in BACKBONES for head in HEADS
    }
    assert {(BACKBONES.name_of(s.backbone), OUTPUTS.name_of(s.output)) for s in every} == {
        (backbone, output) for backbone in BACKBONES for output in OUTPUTS
    }
    assert {CELLS.name_of(s.backbone.cell) for s in every if hasattr(s.backbone, "cell")} == set(CELLS)
    assert {INITIAL_STATES.name_of(s.backbone.initial) for s in every if hasattr(s.backbone, "initial")} == set(
        INITIAL_STATES
    )
    assert all(any(len(s.blocks) > 1 for s in every if BACKBONES.name_of(s.backbone) == name) for name in BACKBONES)
    assert {PHYSICS.name_of(s.physics) for s in structures.values() if s.physics} == set(PHYSICS)


def test_every_file_in_cells_registers_a_recurrent_layer():
    shared = {"__init__", "base", "lstm_steps", "scan"}
    files = {path.stem for path in Path(edp.networks.cells.__path__[0]).glob("*.py")} - shared
    assert files == {CELLS[name].__module__.rpartition(".")[2] for name in CELLS}


def test_every_file_in_blocks_registers_a_block():
    files = {path.stem for path in Path(edp.networks.blocks.__path__[0]).glob("*.py")} - {"__init__", "base"}
    assert files == {BLOCKS[name].__module__.rpartition(".")[2] for name in BLOCKS}


@pytest.mark.parametrize("name", list(BLOCKS))
def test_a_block_names_its_slot_and_a_search_space_of_its_options(name):
    check_space(BLOCKS[name])


@pytest.mark.parametrize(("registry", "name"), ENTRIES)
def test_a_spec_is_frozen_has_defaults_and_survives_json(registry, name):
    check_spec(registry, name)


@pytest.mark.parametrize("registry", [*SPECS, DERIVATIONS], ids=lambda registry: registry.what)
def test_a_misspelt_name_is_answered_with_the_closest(registry: Registry):
    name = next(iter(registry))
    with pytest.raises(ConfigError, match=f"unknown {registry.what} '{name}x'.*{name}"):
        registry[f"{name}x"]
    with pytest.raises(ConfigError, match="registered twice"):
        registry.register(name)(object())  # type: ignore[arg-type]


@pytest.mark.parametrize("backbone", list(BACKBONES))
@pytest.mark.parametrize("block", list(BLOCKS))
def test_a_block_without_its_slot_is_refused(backbone, block):
    spec = BACKBONES[backbone]()
    if BLOCKS[block].slot in {*spec.slots(), *OUTPUT_SLOTS}:
        ModelSpec(backbone=spec, blocks=(BLOCKS[block](),))
    else:
        with pytest.raises(ConfigError, match=f"block '{block}' needs the slot '{BLOCKS[block].slot}'"):
            ModelSpec(backbone=spec, blocks=(BLOCKS[block](),))


@pytest.mark.parametrize(
    ("channels", "kernel", "window", "advice"),
    [
        ((8, 8), 3, 14, "see 13 samples, the window is 14.*give 3 channels entries"),
        ((8,), 1, 2, "use a kernel of at least 2"),
    ],
)
def test_a_tcn_must_see_the_whole_window(channels, kernel, window, advice):
    with pytest.raises(ConfigError, match=advice):
        TcnSpec(channels=channels, kernel=kernel).build(5, window, ())
    TcnSpec(channels=(8, 8), kernel=3).build(5, 13, ())


BAD = [
    lambda: BACKBONES["lstm"](units=0),
    lambda: BACKBONES["lstm"](dropout=1.0),
    lambda: BACKBONES["lstm"](zoneout=1.0),
    lambda: BACKBONES["gru"](layers=0),
    lambda: CELLS["diagonal_ssm"](states=0),
    lambda: INITIAL_STATES["prefix"](ticks=0),
    lambda: BACKBONES["tcn"](channels=()),
    lambda: BACKBONES["hybrid"](channels=(4, 0)),
    lambda: BACKBONES["hybrid"](kernel=0),
    lambda: BLOCKS["cylinder_gate"](form="diagnoal"),
    lambda: BLOCKS["multi_scale_tcn"](first_dilations=(1,)),
    lambda: BLOCKS["multi_scale_tcn"](first_dilations=(0, 1)),
    lambda: BLOCKS["linear_bypass"](taps=0),
    lambda: BLOCKS["linear_bypass"](init="rigde"),
    lambda: BLOCKS["linear_bypass"](init="zero", trainable=False),
    lambda: ACTIVATIONS["stanh"](start=6.0),
    lambda: LOSSES["huber"](delta=0.0),
    lambda: OPTIMIZERS["adamw"](learning_rate=0.0),
    lambda: OPTIMIZERS["discriminative"](rates=(("backbone", 0.0),)),
    lambda: SCHEDULES["cosine"](min_lr_ratio=1.5),
    lambda: ModelSpec(window=0),
    lambda: PHYSICS["kinematic"](pose="angels"),
    lambda: PHYSICS["force"](load="gravitation"),
    lambda: PHYSICS["hybrid"](decay_s=-0.1),
    lambda: PHYSICS["hybrid"](coupled=True, load="gravity"),
]


@pytest.mark.parametrize("make", BAD)
def test_options_out_of_range_are_refused(make):
    with pytest.raises(EdpError, match=r"must hold|unknown|at least|change one"):
        make()
