"""Studies of a made-up world as `study.json` holds them: every phase in both modes, without a training."""

import copy
import dataclasses
import hashlib
import json

import numpy as np
import pytest

from edp.config.experiment import load_experiment
from edp.workflows.search.arms import Arm
from edp.workflows.search.context import SearchContext
from edp.workflows.search.engine import run_phases
from edp.workflows.search.modules import MODULES
from edp.workflows.search.phases import PHASES
from edp.workflows.search.plan import plain_spec
from edp.workflows.search.settings import (
    CalibrationSpec,
    IsolationSpec,
    ModuleScreeningSpec,
    PlanningSpec,
    SearchSpec,
    TrialsSpec,
)
from edp.workflows.search.smaller import Recipe
from edp.workflows.search.space import Choice, Real
from edp.workflows.search.study import SamplerSpec
from edp.workflows.search.trainings import SCORES, Outcome, costs_of

SESSIONS = tuple(f"s{number:02d}" for number in range(12))
SPEC = SearchSpec(
    updates=400,
    folds=3,
    run_seeds=2,
    isolation=IsolationSpec(runs=6),
    calibration=CalibrationSpec(trials=8),
    screening=ModuleScreeningSpec(runs=32, repeats=1, trials=2),
    planning=PlanningSpec(max_runs=6),
    synthesis=TrialsSpec(trials=6),
    exploration=TrialsSpec(trials=12),
    space={"learning_rate": Real(1e-4, 1e-1, log=True), "units": Choice((4, 8, 16, 32))},
    sampler=SamplerSpec(kind="random"),
    backbones=("lstm", "hybrid"),
)
DRAW = 1
"""Number of the draw of the noise: one in which the search confirms both helpful modules on the test sessions."""
TIMES = {"began": "2026-03-04T10:20:00+0000", "ended": "2026-03-04T10:50:00+0000"}


class World:
    """Scores that are known functions of the settings, with a spread by session and seed."""

    def __init__(self):
        self.history, self.phase, self.counts = [], "", {}

    def __call__(self, orders):
        return [self.outcome(order) for order in orders]

    def outcome(self, order):
        score = self.effect(order.settings)
        count = self.counts.setdefault(self.phase, [0, 0])
        count[0] += 1
        count[1] += score is None
        outcome = Outcome(order, "diverged", None, "the loss is nan") if score is None else self.done(order, score)
        number = outcome.mean(10)
        self.history.append(
            {
                "phase": self.phase,
                "number": len(self.history),
                "status": outcome.status,
                "score": float(number) if np.isfinite(number) else None,
                "seconds": 2.5,
                "parameters": costs_of(Arm(order.settings))["parameters"] if self.phase == "calibration" else None,
                "macs_tick": None,
                "label": f"{order.settings['model']['backbone']['kind']} {order.settings['task']['features']}",
            }
        )
        return outcome

    @staticmethod
    def effect(settings):
        """Best at a rate of 3e-3; FG2, hybrids and larger networks better; some modules help, some harm."""
        rate = np.log10(settings["training"]["optimizer"]["learning_rate"])
        if rate > -1.2:
            return None
        score = 5.0 + 0.5 * (rate + 2.5) ** 2 - 0.02 * settings["model"]["backbone"].get("units", 4)
        score -= 0.5 * (settings["task"]["features"] == "FG2") + 0.3 * (
            settings["model"]["backbone"]["kind"] == "hybrid"
        )
        kinds = {block["kind"] for block in settings["model"]["blocks"]}
        score *= 1 - 0.06 * ("squeeze_excitation" in kinds) - 0.03 * ("attention_bridge" in kinds)
        return score * (1 + 0.06 * (settings["model"]["backbone"].get("zoneout", 0) > 0))

    @staticmethod
    def done(order, score):
        text = json.dumps([DRAW, order.settings, order.seed], sort_keys=True).encode()
        rng = np.random.default_rng(int.from_bytes(hashlib.blake2b(text, digest_size=8).digest(), "big"))
        sessions = {}
        for name in order.judged:
            value = score + 0.1 * int(name[1:]) + 0.08 * rng.normal()
            factors = {"mae": 0.6, "rmse": 0.8, "p95": 1.7, "p99": 2.4, "composite": 1.0}
            sessions[name] = {"10": {key: float(value * factors[key]) for key in SCORES}}
        more = {} if order.recipe is None else smaller_outcome(order, score)
        return Outcome(order, "done", {"sessions": sessions, **more})


def smaller_outcome(order, score):
    """What phase 6 is told of a network: wider ones are better, and all but the teacher fit."""
    recipe = Recipe.from_json(order.recipe)
    width = recipe.units or order.settings["model"]["backbone"]["units"]
    formats = {}
    for name in [recipe.final] if recipe.final else recipe.formats:
        if recipe.rounded and name != "w8a16":
            continue
        mae = score * (1 + 1 / width) * (1.0 if name == "float32" else 1.02)
        size = 400 * width if name == "float32" else 100 * width
        taken = {"parameters": 100 * width, "macs_tick": 100 * width, "macs_window": 900 * width}
        taken |= {"cycles": [900 * width] * 3, "parameter_bytes": size, "ram_bytes": size, "flash_bytes": size}
        over = {"cycles": [900 * width, 1]} if recipe.units is None else {}
        formats[name] = {"scores": {"10": {"mae": mae, "composite": mae}}, "resource_usage": taken, "over": over}
    plain = {"10": {"mae": score * (1 + 1 / width), "composite": score}}
    return {"formats": formats, "plain": plain, "left_out": {}}


def study_of(spec):
    """What the search writes, from all phases on the made-up world."""
    base = Arm.from_experiment(load_experiment(None, "quick", ["model.blocks=[]", "model.backbone.units=4"]))
    context, world = (
        SearchContext(spec, base, {"path": "nowhere"}, SESSIONS[:9], SESSIONS[9:11], second=SESSIONS[11:]),
        World(),
    )
    for name in PHASES:
        world.phase = name
        context = run_phases(context, world, phases=[name])
    study = {
        "schema": 2,
        "state": "finished",
        "mode": spec.mode,
        "preset": "quick",
        "unit": "mm/s",
        "data": {"path": "m22.toml", "sessions": len(SESSIONS), "hours": 1.2, "hash": "0123abcd"},
        "spec": plain_spec(spec),
        "sessions": {"development": list(SESSIONS[:9]), "test": list(SESSIONS[9:11]), "second": list(SESSIONS[11:])},
        "modules": {name: module.title for name, module in MODULES.items()},
        "decisions": [held.to_json() for held in context.decided.values()],
        "phases": [
            {
                "name": name,
                "title": phase.title,
                "trainings": world.counts.get(name, [0, 0])[0],
                "trained": world.counts.get(name, [0, 0])[0],
                "failed": world.counts.get(name, [0, 0])[1],
                "seconds": 2.5 * world.counts.get(name, [0, 0])[0],
                "wall_s": 1.3 * world.counts.get(name, [0, 0])[0],
                **TIMES,
            }
            for name, phase in PHASES.items()
        ],
        "history": world.history,
        "openings": [
            {"test_set": "test", "judged": ["a1", "b2", "c3", "d4"], "why": "phase 4", "time": TIMES["ended"]},
            {"test_set": "second test sessions", "judged": ["e5", "f6"], "why": "phase 6", "time": TIMES["ended"]},
        ],
    }
    return json.loads(json.dumps(study, allow_nan=False))


@pytest.fixture(scope="session")
def sound_once():
    return study_of(SPEC)


@pytest.fixture(scope="session")
def thesis_once():
    return study_of(dataclasses.replace(SPEC, mode="thesis", planning=PlanningSpec(max_runs=6, min_effect=0.01)))


@pytest.fixture
def sound(sound_once):
    return copy.deepcopy(sound_once)


@pytest.fixture
def thesis(thesis_once):
    return copy.deepcopy(thesis_once)


def until(study, last):
    """The study as it was while phase `last` ran."""
    names = [phase["name"] for phase in study["phases"]]
    place = names.index(last)
    made = copy.deepcopy(study) | {"state": "running"}
    made["decisions"] = made["decisions"][:place]
    made["phases"] = made["phases"][: place + 1]
    made["phases"][-1] |= {"ended": None, "trained": max(0, made["phases"][-1]["trained"] - 2)}
    made["history"] = [held for held in made["history"] if held["phase"] in names[: place + 1]]
    for row in made["history"][-2:]:
        if row["phase"] == last:
            row["status"] = "waiting"
            del row["score"], row["seconds"], row["parameters"], row["macs_tick"]
    made["openings"] = made["openings"][:1] if place > names.index("synthesis") else []
    return made


@pytest.fixture
def unfinished():
    return until
