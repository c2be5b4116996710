"""What several test folders share: every network that the registries allow, small."""

from __future__ import annotations

import copy
import gc
from collections.abc import Callable, Generator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import beforehand as beforehand  # the first of all, see there
import compiled
import numpy as np
import process_guard
import processor_time
import pytest
import recordings
import torch

from edp.data.task import TargetMode, Task
from edp.errors import ConfigError, ExportError
from edp.ir.w8a16 import calibrate
from edp.networks.activations import ACTIVATIONS
from edp.networks.backbones import BACKBONES, CommitteeSpec, GruSpec, HybridSpec, LstmSpec, TcnSpec
from edp.networks.blocks import BLOCKS
from edp.networks.blocks.base import OUTPUT_SLOTS, SHARED_SLOTS
from edp.networks.cells import CELLS
from edp.networks.heads import HEADS, GluHead, LinearHead, MlpHead
from edp.networks.initial import INITIAL_STATES
from edp.networks.integer import IntegerPredictor
from edp.networks.outputs import OUTPUTS, Point
from edp.networks.physics import PHYSICS
from edp.networks.predictor import ModelSpec, Predictor, check_combination
from edp.testing.networks import WINDOW, small_network, small_task

# Small options, so that every combination is cheap; a part that is absent here is tested with its defaults.
SMALL = {
    "lstm": [
        LstmSpec(units=6),
        LstmSpec(units=5, layers=2, dropout=0.2),
        LstmSpec(units=4, zoneout=0.2, cell=CELLS["layer_norm_lstm"]()),
    ],
    "gru": [GruSpec(units=6), GruSpec(units=5, layers=2, dropout=0.2)],
    "tcn": [TcnSpec(channels=(6, 4), kernel=3, dropout=0.2)],
    "hybrid": [
        HybridSpec(channels=(6,), kernel=3, units=5, dropout=0.2),
        HybridSpec(channels=(4,), kernel=1, units=4),
        HybridSpec(channels=(4,), kernel=2, units=4, zoneout=0.3),
        *(HybridSpec(channels=(4,), kernel=2, units=4, layers=2, cell=CELLS[name]()) for name in CELLS),
        *(
            HybridSpec(channels=(4,), kernel=2, units=3, initial=spec)
            for spec in (INITIAL_STATES["constant"](), INITIAL_STATES["prefix"](ticks=5, hidden=3))
        ),
    ],
    "committee": [
        CommitteeSpec(
            lags=(1, 3, 4, 6),
            smoothed=(3, 6),
            members=2,
            units=4,
            centres=5,
            local_lags=(0, 3),
            trees=5,
            tree_depth=3,
            clip_inputs=True,
        ),
        CommitteeSpec(lags=(2, 5), members=1, units=4, layers=1, activations=("relu",), dropout=0.2),
    ],
    "cylinder_gate": [BLOCKS["cylinder_gate"](), BLOCKS["cylinder_gate"](form="linear")],
    "attention_bridge": [BLOCKS["attention_bridge"](heads=2)],
    "squeeze_excitation": [BLOCKS["squeeze_excitation"](reduction=2)],
    "machine_code": [BLOCKS["machine_code"](size=3)],
    "mlp": [MlpHead(hidden=6), MlpHead(hidden=5, layers=2)],
    "glu": [GluHead(hidden=4), GluHead(hidden=4, layers=2)],
    "linear": [LinearHead(dead_band=True)],
    "linear_bypass": [BLOCKS["linear_bypass"](taps=4), BLOCKS["linear_bypass"](taps=1, trainable=False)],
}
FORMS = [
    (activation, horizons, mode)
    for activation in ACTIVATIONS
    for horizons in ((3,), (1, 4))
    for mode in (TargetMode.DELTA, TargetMode.ABSOLUTE)
]
Form = tuple[str, tuple[int, ...], TargetMode]


class Structure(NamedTuple):
    backbone: object
    blocks: tuple[object, ...] = ()
    head: object = MlpHead(hidden=6)
    output: object = Point()
    physics: object = None


def options_of(name: str, registry: object) -> list[object]:
    return list(SMALL.get(name, [])) or [registry[name]()]  # type: ignore[index]


def _structures() -> dict[str, Structure]:
    """Each backbone alone, with each block that fits it, with each head and output, and with its slots full."""
    found: dict[str, Structure] = {}
    for name in BACKBONES:
        for number, backbone in enumerate(options_of(name, BACKBONES)):
            found[f"{name}{number or ''}"] = Structure(backbone)
        backbone = options_of(name, BACKBONES)[0]
        slots = {*backbone.slots(), *OUTPUT_SLOTS}  # type: ignore[attr-defined]
        full: dict[str, object] = {}
        for block in BLOCKS:
            slot = BLOCKS[block].slot
            if slot in slots:
                full.setdefault(block if slot in SHARED_SLOTS else slot, options_of(block, BLOCKS)[0])
                for number, spec in enumerate(options_of(block, BLOCKS)):
                    found[f"{name}+{block}{number or ''}"] = Structure(backbone, (spec,))
        for head in HEADS:
            for number, spec in enumerate(options_of(head, HEADS)):
                if (head, number) != ("mlp", 0):
                    found[f"{name}+{head}{number or ''}"] = Structure(backbone, (), spec)
        for output in OUTPUTS:
            if output != "point":
                found[f"{name}+{output}"] = Structure(backbone, output=OUTPUTS[output]())
        found[f"{name}+all"] = Structure(backbone, tuple(full.values()), options_of("glu", HEADS)[0])
    return found


def _physical() -> dict[str, Structure]:
    """Each physics base beside one backbone: it meets the network at the output only."""
    variants = {
        "kinematic": [{}, {"pose": "strokes"}],
        "force": [{}, {"load": "none", "decay_s": 0.0, "machine": "C14"}],
        "hybrid": [{"decay_s": 0.0}, {"coupled": True, "pose": "strokes"}],
    }
    return {
        f"lstm+{name} physics{number or ''}": Structure(SMALL["lstm"][0], physics=PHYSICS[name](**options))
        for name in PHYSICS
        for number, options in enumerate(variants.get(name, [{}]))
    }


STRUCTURES = _structures() | _physical()
ALONE = ("tcn+squeeze_excitation", "hybrid+multi_scale_tcn", "hybrid+machine_code", "gru+linear")
"""The only ones in which some layer reads the output of some other."""


def _covering() -> tuple[str, ...]:
    """Structures that hold every part with each of its options, and each backbone with blocks and without.

    The ones with most parts come first. Their graphs hold every layer, and every pair of layers, that any graph holds
    (tests/contracts/test_graph.py), so that what is made of graphs is held to them; `slow` holds it to all.
    """
    held: set[object] = set()
    chosen = list(ALONE)
    for name, structure in sorted(STRUCTURES.items(), key=lambda item: -len(item[1].blocks)):
        backbone, blocks, *others = structure
        now = {backbone, (type(backbone), bool(blocks)), *blocks, *others}
        if not now <= held:
            held |= now
            chosen.append(name)
    return tuple(chosen)


COVERING = _covering()


def model_of(structure: str, activation: str) -> ModelSpec:
    backbone, blocks, head, output, physics = STRUCTURES[structure]
    return ModelSpec(
        backbone=backbone,  # type: ignore[arg-type]
        head=head,  # type: ignore[arg-type]
        output=output,  # type: ignore[arg-type]
        activation=ACTIVATIONS[activation](),
        blocks=blocks,
        window=WINDOW,
        physics=physics,  # type: ignore[arg-type]
    )


def task_of(form: Form, model: ModelSpec) -> Task:
    return small_task(model, form[1], form[2])


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--no-processes", action="store_true", help="leave out what starts processes, and refuse them")
    parser.addoption("--processor-times", action="store_true", help="print where the processor time goes")


def pytest_configure(config: pytest.Config) -> None:
    """Fill the cache of compiled code before workers start: side by side each would compile its own variant."""
    if config.getoption("--no-processes"):
        process_guard.install()
    if config.getoption("--processor-times"):
        config.pluginmanager.register(processor_time)
    cache = config.rootpath / ".pytest_cache" / "compiled"
    compiled.install(cache)
    if not hasattr(config, "workerinput"):
        compiled.warm_numba(cache)


def pytest_collection_finish() -> None:
    """Take what was imported and collected, some half a million objects, out of every later collection of garbage.

    Later ones are rarer, too: by default every 700 new objects.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 10, 20)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Files that `--no-processes` leaves out whole are not imported: their libraries cost each worker seconds."""
    return True if config.getoption("--no-processes") and process_guard.leaves_out(collection_path) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark what starts processes by where it lies and by its fixtures; `--no-processes` leaves that out."""
    for item in items:
        if process_guard.starts_processes(item):
            item.add_marker("processes")
    if config.getoption("--no-processes"):
        left_out = [item for item in items if any(map(item.get_closest_marker, ("processes", "long")))]
        config.hook.pytest_deselected(items=left_out)
        items[:] = [item for item in items if item not in set(left_out)]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    if not item.config.getoption("--no-processes"):
        recordings.begin(process_guard.place_of(item))
        return (yield)
    with process_guard.watching():
        return (yield)


@cache
def forms_of(structure: str) -> list[Form]:
    """The forms in which the parts of a structure agree to be built."""
    agreed = []
    for form in FORMS:
        try:
            model = model_of(structure, form[0])
            check_combination(task_of(form, model), model)
        except ConfigError:
            continue
        agreed.append(form)
    return agreed


@cache
def _build(structure: str, form: Form, shake: float) -> Predictor:
    spec = model_of(structure, form[0])
    return small_network(spec, task_of(form, spec), shake)


@pytest.fixture(scope="session")
def predictor_of() -> Callable[..., Predictor]:
    """Predictors by structure, form and dtype, in evaluation mode; built once, so tests leave them as they are."""

    @cache
    def make(
        structure: str, form: Form | None = None, dtype: torch.dtype = torch.float64, shake: float = 0.2
    ) -> Predictor:
        # Where a test does not go through all forms, neighbouring structures still take different ones.
        agreed = forms_of(structure)
        chosen = form or agreed[list(STRUCTURES).index(structure) % len(agreed)]
        return copy.deepcopy(_build(structure, chosen, shake)).to(dtype).eval()

    return make


def smooth_rows(predictor: Predictor, ticks: int = 300, seed: int = 0) -> np.ndarray:
    """Smooth random inputs ``(time, input)`` of unit size."""
    noise = np.random.default_rng(seed).normal(size=(ticks, predictor.front.inputs))
    rows = np.zeros_like(noise)
    for tick in range(1, ticks):
        rows[tick] = 0.9 * rows[tick - 1] + 0.4 * noise[tick]
    return rows.astype(np.float32)


@pytest.fixture(scope="session")
def rows_of() -> Callable[..., np.ndarray]:
    """Smooth random inputs of a predictor."""
    return smooth_rows


@pytest.fixture(scope="session")
def integers_of(predictor_of) -> Callable[[str], IntegerPredictor]:
    """Predictors in integers by structure, calibrated on smooth random inputs.

    Skips, with the reason that was given, where a network has no such form.
    """

    @cache
    def make(structure: str) -> IntegerPredictor | str:
        predictor = predictor_of(structure, dtype=torch.float32)
        try:
            return IntegerPredictor(predictor, calibrate(predictor.graph(), [smooth_rows(predictor)]))
        except ExportError as error:
            return str(error)

    def given(structure: str) -> IntegerPredictor:
        found = make(structure)
        if isinstance(found, str):
            pytest.skip(found)
        return found

    return given


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Tensors here are tiny: a second thread only costs.

    Without an accelerator every `torch.manual_seed` writes down the stack for one that may come later: a third of a
    millisecond under the frames of a test runner.
    """
    torch.set_num_threads(1)
    if not torch.cuda.is_available():
        for device in (torch.cuda, torch.xpu):
            device.random._lazy_call = lambda *_, **__: None


@pytest.fixture(scope="session")
def parts() -> tuple[dict[str, Structure], list[Form]]:
    """All structures and all forms, to count that the tests are total."""
    return STRUCTURES, FORMS


@pytest.fixture(scope="session")
def covering() -> tuple[str, ...]:
    """Structures that hold every part, each option and every pair of layers."""
    return COVERING


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """An argument `structure` runs a test for every structure; with `form`, in several forms that it agrees to.

    Each takes every fifth form, neighbours from another start, so that all activations, horizons and modes meet every
    block. Backbones alone and with full slots take the other forms, too, which are slow. With the mark `covering`,
    structures beyond `COVERING` are slow. `make check` takes the covering ones alone.
    """
    quick = metafunc.config.getoption("--no-processes")
    if {"structure", "form"} <= set(metafunc.fixturenames):
        pairs = []
        for number, structure in enumerate(STRUCTURES):
            if quick and structure not in COVERING:
                continue
            agreed = forms_of(structure)
            fast = agreed[number % 5 :: 5]
            every = "+" not in structure or structure.endswith("+all")
            for form in agreed if every else fast:
                name = f"{structure}-{form[0]}-{len(form[1])}-{form[2]}"
                marks = () if form in fast else pytest.mark.slow
                pairs.append(pytest.param(structure, form, id=name, marks=marks))
        metafunc.parametrize(("structure", "form"), pairs)
    elif "structure" in metafunc.fixturenames:
        fast = COVERING if quick or metafunc.definition.get_closest_marker("covering") else STRUCTURES
        marks = {name: () if name in fast else pytest.mark.slow for name in STRUCTURES}
        metafunc.parametrize("structure", [pytest.param(name, marks=mark) for name, mark in marks.items()])
