"""What a twin's provenance says of the machine that it learned from."""

from types import SimpleNamespace

import pytest

from edp.training.twin_bundle import STROKES
from edp.workflows.twin.train_twin import _full_strokes

M22, C14 = [1.26, 1.504, 1.104], [1.0, 1.0, 0.915]


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ([M22, M22], {STROKES: M22}),
        ([M22, None, M22], {STROKES: M22}),
        ([None], {}),
        ([M22, C14], {}),
        (["long"], {}),
        ([["a", "b"]], {}),
        ([{"a": 1}, M22], {}),
        ([M22, 3], {}),
    ],
)
def test_strokes_are_those_that_all_recordings_state_which_state_any(stated, expected):
    recordings = [SimpleNamespace(meta={} if value is None else {STROKES: value}) for value in stated]
    assert _full_strokes(recordings) == expected
