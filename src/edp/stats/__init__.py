"""Statistics of model search as plain functions: tests of paired runs, power, races, screening designs.

Scores are better when lower, differences are module minus baseline, tests are one-sided for a mean below zero.
The functions do not train models or write files, and random values always come from a seed.
"""

from edp.stats.clustered import MeanTest, clustered_t
from edp.stats.confirm import ModuleEvidence, Rule, confirm
from edp.stats.effects import (
    Concordance,
    EffectSize,
    cohens_dz,
    effect_interval,
    effect_size,
    kendalls_w,
    rank_stability,
)
from edp.stats.efficiency import SizeScore, most_efficient
from edp.stats.factorial import Factorial, two_level_design
from edp.stats.folds import repeated_folds, repeated_splits
from edp.stats.importance import MainEffect, main_effects
from edp.stats.mixed import MixedModel, mixed_model
from edp.stats.multiple import adjust_registered, benjamini_hochberg, holm
from edp.stats.paired import fill_worst, paired, run_means
from edp.stats.power import ConfirmationPlan, plan_runs, power, simulate_differences, simulated_power
from edp.stats.race import INTERIM_ANALYSES, InterimAnalysis, RaceRates, RaceResult, race, race_rates
from edp.stats.resampled import paired_t, printed_p, resampled_t
from edp.stats.thesis_confirm import ThesisEvidence, thesis_confirm
from edp.stats.thesis_power import ThesisPlan, thesis_plan, thesis_power, thesis_splits_analytical
from edp.stats.variance import (
    PairedVariance,
    SplitVariance,
    paired_variance,
    seed_correlation,
    split_variance,
    thesis_variance,
)

__all__ = [
    "INTERIM_ANALYSES",
    "Concordance",
    "ConfirmationPlan",
    "EffectSize",
    "Factorial",
    "InterimAnalysis",
    "MainEffect",
    "MeanTest",
    "MixedModel",
    "ModuleEvidence",
    "PairedVariance",
    "RaceRates",
    "RaceResult",
    "Rule",
    "SizeScore",
    "SplitVariance",
    "ThesisEvidence",
    "ThesisPlan",
    "adjust_registered",
    "benjamini_hochberg",
    "clustered_t",
    "cohens_dz",
    "confirm",
    "effect_interval",
    "effect_size",
    "fill_worst",
    "holm",
    "kendalls_w",
    "main_effects",
    "mixed_model",
    "most_efficient",
    "paired",
    "paired_t",
    "paired_variance",
    "plan_runs",
    "power",
    "printed_p",
    "race",
    "race_rates",
    "rank_stability",
    "repeated_folds",
    "repeated_splits",
    "resampled_t",
    "run_means",
    "seed_correlation",
    "simulate_differences",
    "simulated_power",
    "split_variance",
    "thesis_confirm",
    "thesis_plan",
    "thesis_power",
    "thesis_splits_analytical",
    "thesis_variance",
    "two_level_design",
]
