"""What several test folders share: every network that the registries allow, small."""

from __future__ import annotations

import copy
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
import torch

from edp.blocks import BLOCKS
from edp.blocks.base import Slot
from edp.data.features import Derived, FeatureSet
from edp.data.scaling import Scaler
from edp.data.task import TargetMode, Task
from edp.models.activations import ACTIVATIONS
from edp.models.backbones import BACKBONES, HybridSpec, LstmSpec, TcnSpec
from edp.models.heads import HeadSpec
from edp.models.predictor import ModelSpec, Predictor, build_model

WINDOW = 9
# Small options, so that every combination is cheap; a part that is absent here is tested with its defaults.
SMALL = {
    "lstm": [LstmSpec(units=6), LstmSpec(units=5, layers=2, dropout=0.2)],
    "tcn": [TcnSpec(channels=(6, 4), kernel=3, dropout=0.2)],
    "hybrid": [HybridSpec(channels=(6,), kernel=3, units=5, dropout=0.2), HybridSpec(channels=(4,), kernel=1, units=4)],
    "cylinder_gate": [BLOCKS["cylinder_gate"](), BLOCKS["cylinder_gate"](form="linear")],
    "linear_bypass": [BLOCKS["linear_bypass"](taps=4), BLOCKS["linear_bypass"](taps=1, trained=False)],
}
FEATURES = FeatureSet(
    "contract",
    ("speed_1", "speed_2", "pressure", "lever"),
    (Derived("dpressure", "pressure"), Derived("dload", "load", "derivative")),
    hidden=("load",),
)
FORMS = [
    (activation, horizons, mode)
    for activation in ACTIVATIONS
    for horizons in ((3,), (1, 4))
    for mode in (TargetMode.DELTA, TargetMode.ABSOLUTE)
]
Form = tuple[str, tuple[int, ...], TargetMode]


def options_of(name: str, registry: object) -> list[object]:
    return list(SMALL.get(name, [])) or [registry[name]()]  # type: ignore[index]


def _structures() -> dict[str, tuple[object, tuple[object, ...]]]:
    """Each backbone alone, with each block that fits it, and with one block in each of its slots."""
    found: dict[str, tuple[object, tuple[object, ...]]] = {}
    for name in BACKBONES:
        for number, backbone in enumerate(options_of(name, BACKBONES)):
            found[f"{name}{number or ''}"] = (backbone, ())
        backbone = options_of(name, BACKBONES)[0]
        slots = {*backbone.slots(), Slot.GATE, Slot.BYPASS}  # type: ignore[attr-defined]
        one_of_each = {}
        for block in BLOCKS:
            if BLOCKS[block].slot in slots:
                one_of_each[BLOCKS[block].slot] = options_of(block, BLOCKS)[0]
                for number, spec in enumerate(options_of(block, BLOCKS)):
                    found[f"{name}+{block}{number or ''}"] = (backbone, (spec,))
        found[f"{name}+all"] = (backbone, tuple(one_of_each.values()))
    return found


STRUCTURES = _structures()


@cache
def _build(structure: str, form: Form) -> Predictor:
    activation, horizons, mode = form
    task = Task(FEATURES, ("speed_1", "speed_2"), horizons, mode, 100.0)
    backbone, blocks = STRUCTURES[structure]
    spec = ModelSpec(
        backbone=backbone,  # type: ignore[arg-type]
        head=HeadSpec(hidden=6),
        activation=ACTIVATIONS[activation](),
        blocks=blocks,
        window=WINDOW,
    )
    rng = np.random.default_rng(7)
    shape = (len(horizons), 2)
    scaler = Scaler(rng.normal(size=6), rng.uniform(0.5, 2, 6), rng.normal(size=shape), rng.uniform(0.5, 2, shape))
    predictor = build_model(task, spec, scaler, seed=3)
    # Some parts start at zero or fully open; shaken weights let every path take part.
    shake = torch.Generator().manual_seed(11)
    with torch.no_grad():
        for parameter in predictor.parameters():
            parameter.add_(0.2 * torch.randn(parameter.shape, generator=shake))
    return predictor


@pytest.fixture(scope="session")
def predictor_of() -> Callable[..., Predictor]:
    """Predictors by structure, form and dtype, in evaluation mode; built once, so tests leave them as they are."""

    @cache
    def make(structure: str, form: Form | None = None, dtype: torch.dtype = torch.float64) -> Predictor:
        # Where a test does not go through all forms, neighbouring structures still take different ones.
        chosen = form or FORMS[list(STRUCTURES).index(structure) % len(FORMS)]
        return copy.deepcopy(_build(structure, chosen)).to(dtype).eval()

    return make


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Tensors here are tiny: a second thread only costs."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def parts() -> tuple[dict[str, tuple[object, tuple[object, ...]]], list[Form]]:
    """All structures and all forms, to count that the tests are total."""
    return STRUCTURES, FORMS


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """An argument `structure` or `form` runs a test for every structure or form."""
    if "structure" in metafunc.fixturenames:
        metafunc.parametrize("structure", list(STRUCTURES))
    if "form" in metafunc.fixturenames:
        names = [f"{activation}-{len(horizons)}-{mode}" for activation, horizons, mode in FORMS]
        metafunc.parametrize("form", FORMS, ids=names)
