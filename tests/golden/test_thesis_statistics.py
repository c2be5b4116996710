"""The thesis's printed p-values (Table 4.5) and its sample-size formulas, from the figures that it prints."""

import math

import numpy as np
import pytest
from scipy.stats import nct, norm, t

from edp.stats import benjamini_hochberg, printed_p, thesis_plan, thesis_power, thesis_splits_analytical

# Module: (p, d_z) at k = 1 with 10 splits, then at k = 10 with 7. "<" and ">" stand for "< 0.001" and "> 0.999".
TABLE_4_5 = {
    "Cyl Gate Diagonal": ((0.7442, 0.208), (0.3372, -0.159)),
    "Temporal Diff": ((0.5914, 0.073), ("<", -1.496)),
    "Cross Cyl Attn": (None, (0.9985, 1.121)),
    "GRU Backbone": ((0.9846, 0.683), (">", 2.285)),
    "LayerNorm LSTM": ((">", 1.869), ("<", -1.998)),
    "Multiscale TCN": ((0.0066, -0.785), (0.9999, 1.387)),
    "Zoneout": ((">", 4.360), (0.8285, 0.358)),
    "Attention Bridge": ((0.1101, -0.388), (">", 1.492)),
    "Global Avg Pool": ((0.5116, 0.009), (0.9863, 0.834)),
    "Squeeze-Excitation": ((">", 1.959), (0.0001, -1.468)),
    "Physics Residual": ((">", 18.548), (">", 22.638)),
    "Deeper Head": ((0.6110, 0.089), (0.9824, 0.796)),
    "GLU Head": ((">", 2.212), (0.0007, -1.213)),
    "STanh Activation": ((">", 1.852), ("<", -6.300)),
}
SPLITS = (10, 7)


def entries():
    return [
        (name, splits, *row) for name, rows in TABLE_4_5.items() for splits, row in zip(SPLITS, rows) if row is not None
    ]


def test_all_entries_of_the_table_are_here():
    assert len(entries()) == 27


@pytest.mark.parametrize(("name", "splits", "p", "d_z"), entries())
def test_printed_p(name, splits, p, d_z):
    ours = float(printed_p(d_z, splits))
    if p == "<":
        assert ours < 0.001
    elif p == ">":
        assert ours > 0.999
    else:
        assert ours == pytest.approx(p, abs=5e-4)


def test_the_only_module_confirmed_at_one_sample_does_not_survive_the_adjustment():
    # design/statistics.md, section 2.2: z 0.085 over the 13 modules that were tested at k = 1.
    rows = [(name, float(printed_p(rows[0][1], 10))) for name, rows in TABLE_4_5.items() if rows[0] is not None]
    adjusted = dict(zip([name for name, _ in rows], benjamini_hochberg([p for _, p in rows])))
    assert len(rows) == 13
    assert adjusted["Multiscale TCN"] == pytest.approx(0.085, abs=5e-4)


def test_sample_size_after_equation_2_21_by_hand():
    # Hybrid on FG2, Table 4.3: sigma_seed 0.037 and mean absolute error 1.694 mm/s; z 1.645 and 0.8416.
    by_hand = ((1.644854 + 0.841621) * 0.037 / (0.02 * 1.694)) ** 2
    assert thesis_splits_analytical(0.02 * 1.694, 0.037, 1) == pytest.approx(by_hand, rel=1e-5)
    assert thesis_splits_analytical(0.02 * 1.694, 0.037, 3) == pytest.approx(by_hand / 3, rel=1e-5)


def test_splits_are_capped_at_25_and_rounded_up():
    hard = thesis_plan(1.904, 0.159, 1)  # TCN on FG2 at k = 1
    assert (hard.splits, hard.simulated) == (25, None)
    assert hard.analytical > 100
    mild = thesis_plan(1.694, 0.037, 1)
    assert mild.splits == max(mild.simulated, math.ceil(mild.analytical)) == 8


@pytest.mark.parametrize(("splits", "delta"), [(2, 0.866), (3, 0.5), (10, 0.3)])
def test_simulated_power_is_that_of_a_noncentral_t_variable_above_a_normal_quantile(splits, delta):
    expected = nct.sf(1.644854, splits - 1, math.sqrt(splits) * delta)
    assert thesis_power(splits, delta, 1.0, 1, experiments=40_000) == pytest.approx(expected, abs=0.01)
    if splits == 2:
        assert (expected, t.sf(1.644854, 1)) == pytest.approx((0.50, 0.17), abs=0.005)
        assert norm.sf(1.644854 - math.sqrt(2) * delta) == pytest.approx(0.34, abs=0.005)


def test_simulated_power_is_the_normal_one_where_the_deviation_is_known_well():
    # At 25 splits the sample deviation is close to the true one: power = Phi(sqrt(n) delta / sigma - z).
    expected = 0.5 * math.erfc(-(math.sqrt(25) * 0.5 - 1.644854) / math.sqrt(2))
    assert thesis_power(25, 0.5, 1.0, 1, experiments=20_000) == pytest.approx(expected, abs=0.02)
    assert np.isclose(thesis_power(9, 0.5, 1.0, 1, seed=3), thesis_power(9, 0.5, 1.0, 1, seed=3))
