"""Every figure of a screening against SciPy's, scikit-learn's or a plain loop's."""

import numpy as np
import pytest
from scipy.signal import correlate, lfilter
from scipy.stats import kendalltau, pearsonr, spearmanr
from sklearn.ensemble import RandomForestRegressor
from sklearn.feature_selection import mutual_info_regression

from edp.data.screening.clusters import clusters_of
from edp.data.screening.copies import find_copies, rest_related
from edp.data.screening.forest import Permuted, Rows
from edp.data.screening.information import Information
from edp.data.screening.lagged import compute_lagged_covariances
from edp.data.screening.linear import RIDGE, gram, peaks, unexplained
from edp.data.screening.ranks import Kendall, correlation, rank_columns
from edp.data.screening.spec import ScreeningSpec
from edp.data.screening.table import CandidateTable, Piece, build_table
from edp.data.screening.values import _correlations, _Model

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def sample() -> np.ndarray:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(1200, 6)).astype(np.float32)
    values[:, 1] += values[:, 0]
    values[:, 2] = np.maximum(values[:, 0], 0)  # half of it equal
    values[:, 3] = np.round(values[:, 1], 1)
    values[:, 4] = np.sin(3 * values[:, 0])
    return values


def pairs(count: int) -> list[tuple[int, int]]:
    return [(i, j) for i in range(count) for j in range(i)]


def test_rank_correlations_equal_scipys_with_and_without_equal_values(sample: np.ndarray) -> None:
    ranks = correlation([rank_columns(sample)])
    kendall = Kendall(sample).matrix()
    pearson = correlation([sample[:500], sample[500:]])
    for i, j in pairs(6):
        assert ranks[i, j] == pytest.approx(spearmanr(sample[:, i], sample[:, j]).statistic, abs=1e-12)
        assert kendall[i, j] == pytest.approx(kendalltau(sample[:, i], sample[:, j]).statistic, abs=1e-12)
        exact = pearsonr(sample[:, i].astype(float), sample[:, j].astype(float)).statistic
        assert pearson[i, j] == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize("neighbours", [1, 3, 7])
def test_mutual_information_equals_scikit_learns(sample: np.ndarray, neighbours: int) -> None:
    ours = Information(sample, neighbours).matrix()
    assert np.isnan(np.diag(ours)).all()
    for i, j in pairs(6):
        exact = mutual_info_regression(
            sample[:, [i]].astype(float), sample[:, j].astype(float), n_neighbors=neighbours, random_state=0
        )[0]
        # equal values are told apart by noise of other draws
        tied = {i, j} & {2, 3}
        assert ours[i, j] == pytest.approx(exact, abs=0.03 if tied else 1e-9)


def test_mutual_information_of_a_gaussian_is_what_theory_says() -> None:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(8000, 2))
    x[:, 1] = 0.8 * x[:, 0] + 0.6 * x[:, 1]
    assert Information(x.astype(np.float32), 3).estimate(0, 1) == pytest.approx(-0.5 * np.log(1 - 0.64), abs=0.04)


def table_of(parts: list[list[np.ndarray]]) -> CandidateTable:
    pieces = tuple(Piece(f"p{i}", tuple(part)) for i, part in enumerate(parts))
    width = parts[0][0].shape[1]
    return CandidateTable(tuple("abcdefgh"[:width]), ("generic",) * width, (0, 1), pieces, 100.0, {})


def test_lagged_sums_equal_scipys_correlate_over_stretches_of_any_length() -> None:
    rng = np.random.default_rng(2)
    parts = [
        [rng.normal(1.0, 2.0, (n, 3)).cumsum(axis=0).astype(np.float32) for n in lengths]
        for lengths in ((1501,), (700, 2300), (333, 40))
    ]
    table = table_of(parts)
    lagged = compute_lagged_covariances(table, 60, shifts=2)
    squares = np.zeros(3)
    total = np.zeros((121, 3, 3))
    for stretches in parts:
        mean = np.concatenate(stretches).mean(axis=0, dtype=float)
        for stretch in stretches:
            x = stretch - mean
            squares += np.square(x).sum(axis=0)
            padded = np.pad(x, ((100, 100), (0, 0)))
            for i in range(3):
                for j in range(3):
                    found = correlate(padded[:, i], padded[:, j], method="direct")
                    middle = len(padded) - 1
                    total[:, i, j] += found[middle - 60 : middle + 61]
    assert lagged.pooled() == pytest.approx(total / np.sqrt(np.outer(squares, squares)), abs=2e-6)
    assert lagged.by_piece(np.array([0]))[:, 60, 0, 0] == pytest.approx(1.0, abs=1e-6)
    assert lagged.chance.shape == (3, 2, 121, 3, 2)


def test_a_lag_is_negative_where_the_channel_leads() -> None:
    rng = np.random.default_rng(3)
    command = rng.normal(size=4000)
    answer = np.roll(command, 9)
    lagged = compute_lagged_covariances(table_of([[np.stack([answer, command], 1).astype(np.float32)]] * 2), 20)
    assert lagged.lags[np.abs(lagged.pooled()[:, 1, 0]).argmax()] == -9


def delayed(values: np.ndarray, taps: list[tuple[int, int]], reach: int) -> np.ndarray:
    padded = np.pad(values, ((reach, reach), (0, 0)))
    return np.stack([np.roll(padded[:, i], d) for i, d in taps], axis=1)


def test_linear_models_from_lagged_sums_equal_models_from_rows() -> None:
    rng = np.random.default_rng(4)
    x = rng.normal(size=(3000, 3)).cumsum(axis=0).astype(np.float32)
    x -= x.mean(axis=0)
    lagged = compute_lagged_covariances(table_of([[x], [x[::-1].copy()]]), 30)
    sums = _correlations(lagged, np.array([0]))
    taps = [(i, d) for i in range(3) for d in (0, 1, 4)]
    rows = delayed(x / table_of([[x]]).within, taps, 30)
    exact = rows.T @ rows / len(x)
    assert gram(sums, taps, taps) == pytest.approx(exact, rel=1e-4, abs=1e-4)
    model = _Model(sums, taps, 0, 5)
    change = delayed(x / table_of([[x]]).within, [(0, -5)], 30)[:, 0] - rows[:, 0]
    kept = [0, 1, 2, 6, 7, 8]
    less = np.linalg.solve(exact[np.ix_(kept, kept)] + RIDGE * np.eye(6), rows[:, kept].T @ change / len(x))
    without = model.without(np.array([3, 4, 5]))
    assert (without[3:6] == 0).all()
    # smooth signals leave weights ill determined; what they predict is not
    assert rows @ without == pytest.approx(rows[:, kept] @ less, abs=2e-3 * float(change.std()))
    error = model.error(without, model.moments, model.answers, model.power(sums))
    assert error == pytest.approx(np.square(change - rows @ without).sum() / len(x), rel=2e-2)


def test_what_is_left_of_a_channel_shrinks_with_what_explains_it() -> None:
    rng = np.random.default_rng(5)
    source = rng.normal(size=6000)
    mixed = np.convolve(source, [0.5, 0.5])[:6000] + 0.1 * rng.normal(size=6000)
    x = np.stack([source, mixed], axis=1).astype(np.float32)
    sums = compute_lagged_covariances(table_of([[x], [x]]), 20).pooled()
    before, after = unexplained(sums, 1, [(0, 0)], [(0, 1)])
    assert before == pytest.approx(1 - 0.25 / 0.51, abs=0.03)
    assert after == pytest.approx(0.01 / 0.51, abs=0.005)


def test_a_copy_is_told_from_a_channel_that_only_resembles() -> None:
    rng = np.random.default_rng(6)
    source = rng.normal(size=(20_000)).cumsum() * 0.05
    source -= np.convolve(source, np.ones(400) / 400, "same")
    copy = np.roll(source, 11) + 0.3 * source.std() * rng.normal(size=20_000)
    answer = lfilter([0.1], [1.0, -0.9], source)
    x = np.stack([source, copy, answer], axis=1).astype(np.float32)
    sums = compute_lagged_covariances(table_of([[x], [x]]), 40).pooled()
    found = {(pair.copy, pair.source, pair.lag) for pair in find_copies(sums, 0.99)}
    assert (1, 0, 11) in found
    assert not {pair for pair in found if 2 in pair[:2]}
    lags, best = peaks(sums, -40, 40)
    assert best[2, 0] > 0.7
    assert rest_related(sums, 2, 0, int(lags[2, 0]), float(best[2, 0])) > 0.15


def test_permuting_only_what_a_group_touches_equals_predicting_anew() -> None:
    rng = np.random.default_rng(7)
    x = rng.normal(size=(600, 5)).astype(np.float32)
    y = np.stack([x[:, 0] + x[:, 1] * x[:, 2], np.sin(x[:, 3])], axis=1)
    model = RandomForestRegressor(7, min_samples_leaf=3, random_state=0).fit(x[:400], y[:400])
    rows = Rows(x[400:], y[400:], np.zeros(200, dtype=np.int64))
    permuted = Permuted(model.estimators_, rows, np.array([0, 1, 1, 2, 3]))
    order = rng.permutation(200)
    assert permuted.errors(None, order) == pytest.approx(np.square(model.predict(rows.inputs) - rows.changes))
    for group, columns in ((0, [0]), (1, [1, 2]), (2, [3]), (3, [4])):
        shuffled = rows.inputs.copy()
        shuffled[:, columns] = rows.inputs[order][:, columns]
        exact = np.square(model.predict(shuffled) - rows.changes)
        assert permuted.errors(group, order) == pytest.approx(exact, abs=1e-12)


def test_every_two_members_of_a_cluster_go_together() -> None:
    matrix = np.array([[1.0, 0.95, 0.85, 0.0], [0.95, 1, 0.95, 0], [0.85, 0.95, 1, 0], [0, 0, 0, 1]])
    assert clusters_of(matrix, 0.9) in ([[0, 1], [2], [3]], [[0], [1, 2], [3]])
    assert clusters_of(-matrix, 0.8) == [[0, 1, 2], [3]]
    assert clusters_of(np.ones((1, 1)), 0.9) == [[0]]


def test_pieces_follow_from_recordings(sessions: list) -> None:
    spec = ScreeningSpec(max_lag=40)
    assert [p.name for p in build_table(sessions, spec).pieces] == [r.name for r in sessions]
    assert len(build_table(sessions[:1], ScreeningSpec(max_lag=40, min_segments=4)).pieces) >= 4
    many = build_table([s.rows(i * 500, (i + 1) * 500) for s in sessions for i in range(6)], spec)
    assert len(many.pieces) <= 24
    assert many.samples == 30_000


def test_a_reference_that_a_machine_follows_closely_is_no_copy_of_its_answer() -> None:
    rng = np.random.default_rng(8)
    reference = lfilter([0.01], [1.0, -0.99], rng.normal(size=20_000))
    answer = lfilter([0.2], [1.0, -0.8], np.roll(reference, 5)) + 1e-4 * rng.normal(size=20_000)
    x = np.stack([answer, reference], axis=1).astype(np.float32)
    sums = compute_lagged_covariances(table_of([[x], [x]]), 40).pooled()
    lags, best = peaks(sums, -40, 40)
    assert best[1, 0] > 0.99
    assert lags[1, 0] < -5
    assert not [pair for pair in find_copies(sums, 0.99) if pair.copy == 1]
