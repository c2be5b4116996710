"""For any split of a sequence into chunks, a stream gives what one call gives."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

TICKS = 40
CUTS = st.lists(st.integers(0, TICKS), max_size=8).map(sorted)


def in_chunks(predictor, cuts=()):
    """A stream in chunks between `cuts`, and a second round from the state that they leave."""
    like = next(predictor.parameters())
    x = torch.randn(2, TICKS, predictor.front.inputs, generator=torch.Generator().manual_seed(1)).to(like)
    state, pieces = predictor.initial_state(2, x), []
    with torch.no_grad():
        for start, stop in itertools.pairwise(sorted({0, TICKS, *cuts})):
            y, state = predictor(x[:, start:stop], state)
            pieces.append(y)
        pieces.append(predictor(x, state)[0])
    return torch.cat(pieces, dim=1)


def close(found, wanted, tolerance):
    # An activation-free network reaches some tens; rounding is relative to that.
    torch.testing.assert_close(found, wanted, rtol=0, atol=tolerance * max(1.0, float(wanted.abs().max())))


@pytest.mark.covering
def test_any_split_gives_the_same_stream(structure, predictor_of):
    predictor = predictor_of(structure)
    whole = in_chunks(predictor)

    @settings(max_examples=8, deadline=None, database=None, derandomize=True)
    @given(cuts=CUTS)
    def check(cuts):
        close(in_chunks(predictor, cuts), whole, 1e-10)

    check()


def test_a_split_in_single_precision_gives_the_same_stream_up_to_rounding(structure, predictor_of):
    # Weights near those of a start: rounding grows with them, and 1e-5 is the contract.
    predictor = predictor_of(structure, dtype=torch.float32, shake=0.02)
    close(in_chunks(predictor, [1, 2, 3, 17, 31]), in_chunks(predictor), 1e-5)


def test_tick_by_tick_over_more_than_a_pooling_block(predictor_of):
    """Longer than the 128 ticks that pooling handles at a time."""
    predictor = predictor_of("hybrid+all")
    x = torch.randn(1, 300, predictor.front.inputs, generator=torch.Generator().manual_seed(1)).double()
    with torch.no_grad():
        whole, _ = predictor(x, predictor.initial_state(1, x))
        state, rows = predictor.initial_state(1, x), []
        for t in range(300):
            y, state = predictor(x[:, t : t + 1], state)
            rows.append(y)
    torch.testing.assert_close(torch.cat(rows, dim=1), whole, rtol=0, atol=1e-10)
