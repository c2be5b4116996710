"""For any split of a sequence into chunks, a stream gives what one call gives."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

TICKS = 60
CUTS = st.lists(st.integers(0, TICKS), max_size=8).map(sorted)


@pytest.mark.parametrize(
    ("dtype", "tolerance", "splits"), [(torch.float32, 1e-5, 3), (torch.float64, 1e-10, 8)], ids=["f32", "f64"]
)
def test_any_split_gives_the_same_stream(structure, dtype, tolerance, splits, predictor_of):
    predictor = predictor_of(structure, dtype=dtype)
    x = torch.randn(2, TICKS, predictor.front.inputs, generator=torch.Generator().manual_seed(1)).to(dtype)
    with torch.no_grad():
        whole, last = predictor(x, predictor.initial_state(2, x))
        further, _ = predictor(x, last)
    # An activation-free network reaches some tens; rounding is relative to that.
    tolerance *= max(1.0, float(whole.abs().max()))

    @settings(max_examples=splits, deadline=None, database=None, derandomize=True)
    @given(cuts=CUTS)
    def check(cuts):
        edges = sorted({0, TICKS, *cuts})
        state, pieces = predictor.initial_state(2, x), []
        with torch.no_grad():
            for start, stop in itertools.pairwise(edges):
                y, state = predictor(x[:, start:stop], state)
                pieces.append(y)
            again, _ = predictor(x, state)
        torch.testing.assert_close(torch.cat(pieces, dim=1), whole, rtol=0, atol=tolerance)
        torch.testing.assert_close(again, further, rtol=0, atol=tolerance)

    check()


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
