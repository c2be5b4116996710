"""Keys and values of settings in earlier versions, and those that replace them.

`SettingsTree` reads the earlier names wherever it reads a table: in settings files, bundles, checkpoints and studies.
"""

from __future__ import annotations

import sys
import typing
from collections.abc import Mapping

from edp.errors import ConfigError

T = typing.TypeVar("T")

_SPLIT = {
    "validation_share": "validation_fraction",
    "test_share": "test_fraction",
    "tail_share": "tail_fraction",
    "whole_short": "train_short_recordings",
    "missing": "on_missing",
    "second": "second_test",
}
_FEATURES = {"starting": "init_channels", "starting_ticks": "init_samples"}
_GREY = {"stretches": "curve_segments", "without": "omit"}
KEYS: Mapping[str, Mapping[str, str]] = {
    "AutoSettings": {"judge": "evaluation"},
    "Experiment": {"judge": "evaluation"},
    "TwinExperiment": {"judge": "evaluation"},
    "JudgeSpec": {"skip": "warmup_samples"},
    "FreeRunJudgeSpec": {
        "floors": "baselines",
        "seconds": "duration_s",
        "covered_at_s": "coverage_at_s",
        "ahead_ticks": "horizon",
    },
    "FeatureSettings": _FEATURES,
    "FeatureSet": _FEATURES,
    "Derived": {"seconds": "span_s"},
    "ByRecording": _SPLIT,
    "ByTime": _SPLIT,
    "ByMachine": _SPLIT,
    "ByBlocks": _SPLIT,
    "ByFrozen": _SPLIT,
    "ChunkSpec": {"carried": "reset_after_chunks"},
    "WindowShift": {"most": "max_shift"},
    "OneCycle": {"rise": "warmup", "start": "start_lr_ratio", "floor": "min_lr_ratio"},
    "Cosine": {"floor": "min_lr_ratio"},
    "Plateau": {"shrink": "factor", "floor": "min_lr_ratio"},
    "Stochastic": {"share": "fraction", "rate": "lr_ratio"},
    "TrainingSpec": {"bagging": "ensemble"},
    "BaggingSpec": {
        "robust_width": "huber_delta",
        "checks": "validations",
        "rows": "max_rows",
        "tree_rate": "tree_learning_rate",
        "tree_leaf": "tree_min_leaf_rows",
        "tree_leaves": "tree_max_leaves",
        "tree_rows": "tree_max_rows",
    },
    "CommitteeSpec": {"near": "local_lags", "bounded": "clip_inputs"},
    "AdaptiveWeights": {"memory": "decay"},
    "LinearBypass": {"start": "init", "trained": "trainable"},
    "DynamicSpec": {"fade_s": "decay_s"},
    "Portfolio": {"minutes": "time_budget_min"},
    "AutoTwin": {"minutes": "time_budget_min", "least_gain": "min_gain"},
    "DictionarySpec": {"minutes": "time_budget_min"},
    "MonitorExperiment": {"minutes": "time_budget_min", "train_share": "train_fraction"},
    "AdaptationSpec": {"judged_s": "evaluation_s"},
    "DistillationSpec": {"truth": "target_weight", "soft": "distillation_loss", "hint": "hint_weight"},
    "FinetuneSpec": {
        "rate": "learning_rate",
        "head_rate": "head_learning_rate",
        "backbone_rate": "backbone_learning_rate",
        "inner_rate": "inner_learning_rate",
        "rounds": "single_phase_epochs",
        "soft": "distillation_fraction",
        "reversal": "adversarial_weight",
    },
    "MetaSpec": {"inner_rate": "inner_learning_rate"},
    "ScreeningSpec": {
        "pieces": "min_segments",
        "piece_samples": "segment_samples",
        "trusted": "measured",
        "collinear": "collinearity_threshold",
        "copy": "copy_threshold",
        "level": "significance_level",
    },
    "ForestSpec": {
        "leaf": "min_samples_leaf",
        "share": "max_features",
        "tests": "test_samples",
        "held_out": "test_fraction",
    },
    "SearchSpec": {"second": "second_test", "second_share": "second_test_fraction", "test_share": "test_fraction"},
    "PlanningSpec": {"least_effect": "min_effect", "most_runs": "max_runs"},
    "ConfirmationSpec": {"least_gain": "min_gain"},
    "CompressionSpec": {"on": "enabled", "shares": "width_fractions"},
    "TrialSpec": {"random": "random_sets", "draw": "random_seed", "barred": "excluded_channels"},
    "FreeRunSpec": {
        "lanes": "batch",
        "clip": "clip_norm",
        "measured_share": "measured_fraction",
        "mixed_share": "mixed_fraction",
    },
    "Residual": {"lanes": "batch"},
    "GreyFitSpec": {"lanes": "batch"},
    "GreyBox": _GREY,
    "VirtualSensorsSpec": {"least": "min_explained"},
    "FlowBalancesSpec": {"least": "min_explained"},
    "ChainSpec": {"most_drift": "max_drift"},
    "ModelInversion": {"rest_m_s": "standstill_m_s"},
    "ProportionalIntegral": {"rest_m_s": "standstill_m_s"},
}
"""Keys of earlier versions by the class of the settings that has them."""
VALUES: Mapping[tuple[str, str], Mapping[object, object]] = {
    ("ByFrozen", "on_missing"): {"refuse": "error", "draw": "resample"},
    ("LinearBypass", "init"): {"crossed": "cross_validated"},
    ("Grade", "direction"): {"drawn": "random"},
}
"""Values of earlier versions by the class of the settings and the present key."""
_used: dict[str, str] = {}
"""Keys of earlier versions in settings that this process was given, with the present keys."""


def present_keys(cls: type, table: Mapping[str, T], path: str = "") -> dict[str, T]:
    """Return a table of settings with the keys and values of this version.

    Args:
        cls: dataclass of the settings.
        table: plain values by key; keys that are unknown stay as they are.
        path: key of the table in messages.

    Raises:
        ConfigError: a key is given by its earlier and by its present name.
    """
    present: dict[str, T] = {}
    for key, value in table.items():
        name = earlier(cls).get(key, key) if isinstance(key, str) else key
        if name != key and name in table:
            raise ConfigError(f"'{join(path, key)}' is now '{join(path, name)}', and both are given; delete the first")
        changed = next((VALUES[base.__name__, name] for base in cls.__mro__ if (base.__name__, name) in VALUES), {})
        present[name] = typing.cast(T, changed.get(value, value)) if isinstance(value, str) else value
    return present


def earlier(cls: type) -> Mapping[str, str]:
    """Return the keys of earlier versions of a settings class, with the present keys."""
    renames: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        renames |= KEYS.get(base.__name__, {})
    return renames


def join(path: str, key: str) -> str:
    """Return the key below a path."""
    return f"{path}.{key}" if path else key


def note_earlier(key: str, present: str) -> None:
    """Record that settings were given with an earlier key."""
    _used[sys.intern(key)] = present


def used_earlier_keys() -> Mapping[str, str]:
    """Return the earlier keys in settings that this process was given, with the present keys."""
    return dict(_used)


def common_renames(classes: typing.Iterable[type], present: typing.Collection[str]) -> Mapping[str, str]:
    """Return the renames of a table for several possible classes; a key that a class has is unchanged.

    Args:
        classes: classes that the table may describe.
        present: keys of all these classes.
    """
    renames: dict[str, str] = {}
    for cls in classes:
        renames |= {old: new for old, new in earlier(cls).items() if old not in present}
    return renames
