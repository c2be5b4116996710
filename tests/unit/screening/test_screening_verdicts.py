"""What a screening says of channels of which it is known what they are."""

import json
from dataclasses import replace

import numpy as np
import pytest

from edp.data.screening import FlagKind, ForestSpec, ScreeningResult, ScreeningSpec, screen
from edp.errors import ConfigError, DataError
from edp.recording import Recording

pytestmark = pytest.mark.long

SPEC = ScreeningSpec(
    measured=("lever_a", "lever_b", "pressure"),
    max_lag=60,
    information_samples=1500,
    rank_samples=1500,
    segment_samples=500,
    forest=ForestSpec(trees=10, samples=3000, test_samples=1500, repeats=2),
)


@pytest.fixture(scope="module")
def found(sessions: list[Recording]) -> ScreeningResult:
    return screen(sessions, SPEC)


def flags(found: ScreeningResult) -> dict[str, tuple[FlagKind, str, int]]:
    return {flag.channel: (flag.kind, flag.source, flag.lag) for flag in found.flags}


def test_real_channels_are_kept_and_false_ones_dropped(found: ScreeningResult) -> None:
    assert set(found.proposal.kept) == {"v_a", "v_b", "lever_a", "lever_b", "pressure"}
    assert [choice.rank for choice in found.proposal.choices] == list(range(1, 15))
    assert all(choice.reason and 0 <= choice.score <= 1 for choice in found.proposal.choices)
    assert found.targets == ("v_a", "v_b")


def test_each_false_channel_is_flagged_for_what_it_is(found: ScreeningResult) -> None:
    told = flags(found)
    assert told["aux_ahead"] == (FlagKind.LEAK, "v_b", -15)
    assert told["aux_smooth"][:2] == (FlagKind.LEAK, "v_a")
    assert told["aux_late"] == (FlagKind.COPY, "lever_b", 21)
    assert told["aux_turned"][:2] == (FlagKind.ARTEFACT, "v_a")
    assert told["aux_session"][0] == told["aux_clock"][0] == FlagKind.ARTEFACT
    assert told["aux_noise"][0] == told["aux_slow"][0] == FlagKind.NOISE
    assert told["aux_dead"][0] == FlagKind.CONSTANT
    assert len(told) == 9


def test_lags_have_the_sign_of_table_4_2(found: ScreeningResult) -> None:
    curve = found.curve("lever_b", "v_b")
    assert -14 <= curve.best <= -4
    assert curve.low <= curve.best <= curve.high
    assert curve.certain
    assert not curve.at_edge
    assert not found.curve("aux_noise", "v_a").certain
    assert found.proposal.window >= -curve.best
    (row,) = found.lag_table()
    assert row.group == "generic"
    assert row.low <= curve.best <= row.high
    assert "lever_b" in row.channels
    assert not {"v_a", "aux_ahead"} & {*row.channels, *row.left_out}


def test_without_trust_a_lever_may_stay_and_leaks_of_targets_go(sessions: list[Recording]) -> None:
    told = flags(screen(sessions, replace(SPEC, measured=())))
    assert told["aux_ahead"][0] == told["aux_smooth"][0] == FlagKind.LEAK
    assert "lever_a" not in told
    assert "lever_b" not in told


def test_results_are_plain_json_and_the_same_twice(found: ScreeningResult, sessions: list[Recording]) -> None:
    heard: list[tuple[str, float]] = []
    again = screen(sessions, SPEC, lambda stage, share: heard.append((stage, share)))
    plain = found.to_json() | {"seconds": 0}
    assert json.dumps(plain, allow_nan=False) == json.dumps(again.to_json() | {"seconds": 0}, allow_nan=False)
    assert plain["proposal"]["kept"] == list(found.proposal.kept)
    shares = [share for _, share in heard]
    assert shares == sorted(shares)
    assert 0 <= shares[0] <= shares[-1] <= 1
    assert list(dict.fromkeys(stage for stage, _ in heard)) == list(found.seconds)


def test_matrices_and_tables_are_complete(found: ScreeningResult) -> None:
    count = len(found.channels)
    dead = [found.channels.index(name) for name in ("aux_dead", "aux_session")]
    for matrix in (found.matrices.pearson, found.matrices.spearman, found.matrices.kendall, found.matrices.information):
        assert matrix.shape == (count, count)
        assert np.isnan(matrix[dead]).all()
        assert np.allclose(matrix, matrix.T, equal_nan=True)
    live = count - 2
    assert len(found.lags) == live * 2
    assert len(found.stability) == live * 2 * 5
    assert {entry.target for entry in found.importance} == {"all", "v_a", "v_b"}
    assert {value.channel for value in found.values} == set(found.proposal.kept) | {"aux_noise", "aux_slow"}
    levers = [v for v in found.values if (v.channel, v.target) == ("lever_b", "v_b")]
    assert levers[0].low > 0.2


def test_at_horizon_0_targets_are_no_inputs(sessions: list[Recording]) -> None:
    found = screen(sessions, replace(SPEC, horizon=0, candidates=("lever_a", "lever_b", "pressure", "aux_noise")))
    assert set(found.proposal.kept) == {"lever_a", "lever_b", "pressure"}
    assert "horizon 0" in next(c for c in found.proposal.choices if c.channel == "v_a").reason


def test_one_long_recording_is_cut_and_a_channel_with_gaps_set_aside(sessions: list[Recording]) -> None:
    values = np.concatenate([s.values for s in sessions])
    values[500, sessions[0].index("pressure")] = np.nan
    spec = replace(SPEC, candidates=("lever_a", "lever_b", "pressure", "aux_noise"))
    found = screen([replace(sessions[0], values=values)], spec)
    assert len(found.pieces) >= spec.min_segments
    assert flags(found)["pressure"][0] == FlagKind.MISSING
    assert {"lever_a", "lever_b"} <= set(found.proposal.kept)
    assert "pressure" in found.proposal.dropped


def test_recordings_too_short_for_the_lags_are_left_out_and_named(sessions: list[Recording]) -> None:
    spec = replace(SPEC, candidates=("lever_a", "aux_noise"), information_samples=500)
    found = screen([*sessions[:6], sessions[6].rows(0, 40, "tiny")], spec)
    assert "tiny" in next(note for note in found.proposal.notes if "too short" in note)
    assert "lever_a" in found.proposal.kept


def test_nothing_to_predict_from_is_an_error(sessions: list[Recording]) -> None:
    with pytest.raises(DataError, match="at horizon 0 targets are no inputs"):
        screen(sessions, replace(SPEC, horizon=0, candidates=("aux_dead",)))


def test_bad_requests_are_named(sessions: list[Recording]) -> None:
    with pytest.raises(DataError, match="no recordings"):
        screen([])
    with pytest.raises(DataError, match=r"100 Hz; screening needs one rate"):
        screen([sessions[0], replace(sessions[1], rate_hz=50.0)])
    with pytest.raises(DataError, match="lacks; did you mean 'pressure'"):
        screen(sessions, replace(SPEC, targets=("presure",)))
    with pytest.raises(DataError, match="target 'aux_dead' never changes"):
        screen(sessions, replace(SPEC, targets=("aux_dead",)))
    with pytest.raises(DataError, match="0 of 10 recordings are long enough, the longest has 300"):
        screen([s.rows(0, 300) for s in sessions])
    broken = sessions[0].values.copy()
    broken[3, 0] = np.nan
    with pytest.raises(DataError, match="target 'v_a' has 1 missing"):
        screen([replace(sessions[0], values=broken), *sessions[1:]], SPEC)
    still = [replace(s, channels=s.channels[2:], values=s.values[:, 2:]) for s in sessions]
    with pytest.raises(DataError, match="has no velocity"):
        screen(still)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"horizon": -1}, "horizon = -1"),
        ({"horizon": 70}, "beyond max_lag"),
        ({"copy_threshold": 1.0}, "0 < copy_threshold < 1 must hold"),
        ({"min_segments": 2}, "4 <= min_segments"),
        ({"information_samples": 10}, "100 <= information_samples"),
    ],
)
def test_wrong_options_are_refused(wrong: dict, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        replace(SPEC, **wrong)
    with pytest.raises(ConfigError, match=r"screening\.forest: trees = 0"):
        ForestSpec(trees=0)
    with pytest.raises(ConfigError, match=r"0 < test_fraction <= 0\.8"):
        ForestSpec(test_fraction=0.9)
