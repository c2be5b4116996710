"""Every error that a user can meet has an identifier, and the page of errors explains it."""

import pytest

from edp.cli import app
from edp.cli.console import run_app
from edp.cli.error_index import VALUE, identify, list_messages
from edp.errors import BundleError, DataError
from edp.logs.units import check_unit


def test_messages_of_the_package_have_distinct_identifiers_and_mostly_a_remedy():
    messages = list_messages()
    assert len(messages) > 1000
    assert len({message.identifier for message in messages}) == len(messages)
    assert len({message.template for message in messages}) == len(messages)
    assert sum(bool(message.remedy) for message in messages) > 0.6 * len(messages)
    assert not [message for message in messages if message.error in ("ValueError", "TypeError", "OSError")]


def test_raised_error_is_identified_by_its_traceback():
    with pytest.raises(DataError) as caught:
        check_unit("furlong", "channel 'x'")
    by_identifier = {message.identifier: message for message in list_messages()}
    message = by_identifier[identify(caught.value)]
    assert message.fits(str(caught.value))
    assert message.module == "edp.logs.units"


def test_error_of_another_process_is_identified_by_its_text():
    message = next(one for one in list_messages() if one.template.count(VALUE) == 1 and one.letters > 60)
    assert identify(DataError(message.template.replace(VALUE, "log 7"))) == message.identifier


def test_unknown_message_has_no_identifier():
    assert identify(BundleError("zzz qqq")) == ""
    assert identify(BundleError("x" * 100_000)) == ""


def test_most_specific_template_wins():
    for message in list_messages()[:: max(len(list_messages()) // 50, 1)]:
        text = message.template.replace(VALUE, "7")
        if message.letters >= 20:
            identifier = identify(DataError(text))
            chosen = next(one for one in list_messages() if one.identifier == identifier)
            assert chosen.letters >= message.letters


def test_command_line_prints_the_identifier(capsys, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["edp", "evaluate", str(tmp_path / "missing")])
    assert run_app(app) == 1
    shown = capsys.readouterr().err
    identifiers = {message.identifier for message in list_messages()}
    assert shown.rstrip().rpartition(" ")[2].strip("[]") in identifiers
