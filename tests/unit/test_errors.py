"""Errors: messages are bounded, whatever a file puts into them."""

import copy

from edp.errors import MAX_CHARACTERS, DataError, EdpError


def test_a_message_keeps_its_beginning_and_its_end():
    message = str(DataError(f"'log.csv': the column '{'x' * 100_000}' is unknown; rename it"))
    assert len(message) < MAX_CHARACTERS + 100
    assert message.startswith("'log.csv': the column")
    assert message.endswith("rename it")
    assert "characters left out" in message


def test_a_usual_message_is_kept_as_it_is():
    assert str(EdpError("what came")) == "what came"
    assert str(copy.copy(EdpError("what came"))) == "what came"
