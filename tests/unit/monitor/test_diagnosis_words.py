"""What an alarm says: sentences, severity, and what cannot be told apart."""

from dataclasses import replace
from datetime import datetime

import numpy as np
import pytest

from edp.errors import DataError
from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause, class_of
from edp.monitor.diagnosis.sentences import alarm_sentence, cause_words, clock, size_text
from edp.monitor.diagnosis.severity import severity
from edp.monitor.diagnosis.structure import confusions
from edp.workflows.monitor.fault_sessions import fault_classes

BIAS, MINUS = fault_classes(["pressure_bias"])[:2]
(LEAK,) = [fault for fault in fault_classes(["external_leak"]) if fault.site == "boom_rod"]


def cause(fault, size, probability, grade=0.5):
    words = cause_words(fault, size)
    return Cause(
        fault.kind,
        fault.site,
        fault.component,
        fault.at_fault,
        size,
        fault.unit,
        probability,
        words,
        grade,
        fault.grave,
    )


def test_a_sentence_says_what_by_how_much_since_when_and_how_sure():
    causes = [cause(BIAS, 9.8, 0.93), cause(LEAK, 1.0, 0.05)]
    at = datetime.fromisoformat("2026-11-23T13:58:10")
    assert alarm_sentence(causes, 241.0, at) == (
        "head pressure of the boom reads 9.8 bar too high since 14:02:11; 0.93"
    )
    assert alarm_sentence(causes, 3841.0).endswith("since 1:04:01; 0.93")


def test_the_sign_of_a_size_turns_the_words():
    assert MINUS.name == "pressure_bias:boom_head:-"
    assert cause_words(MINUS, -3.0) == "head pressure of the boom reads 3.0 bar too low"


def test_what_is_not_sure_is_a_guess():
    low = [cause(BIAS, 9.8, 0.3), cause(LEAK, 1.0, 0.25)]
    assert alarm_sentence(low, 5.0).startswith("not clear what changed since 0:00:05: perhaps")
    other = replace(low[0], kind="pressure_scale", probability=0.4)
    assert alarm_sentence([low[0], other], 5.0).startswith("sensor of boom head pressure: perhaps")
    unknown = Cause(NONE_OF_THESE, "", "", "none", None, "", 0.8, "unknown")
    assert "no fault of the dictionary explains since 0:00:05; 0.80" in alarm_sentence([unknown], 5.0)
    assert "otherwise than on the healthy sessions" in alarm_sentence([], 5.0)


def test_text_of_a_file_is_never_a_format():
    fault = replace(BIAS, words="{0.__class__} reads {size} too {high}")
    assert cause_words(fault, 2.0) == "{0.__class__} reads 2.0 bar too high"


@pytest.mark.parametrize(
    ("size", "unit", "text"),
    [
        (9.8, "bar", "9.8 bar"),
        (1250.0, "kg", "1,250 kg"),
        (0.31, "L/min", "0.31 L/min"),
        (1.5, "x", "1.5x"),
        (0.0, "%", "0 %"),
    ],
)
def test_sizes_have_two_digits_at_least(size, unit, text):
    assert size_text(size, unit) == text


def test_clocks_count_hours():
    assert clock(7325.4) == "2:02:05"


def test_only_large_grave_faults_stop_a_machine():
    assert severity([cause(LEAK, 10.0, 0.8, 1.0)]) == "stop"
    assert severity([cause(LEAK, 1.0, 0.8, 0.4)]) == "warning"
    assert severity([cause(LEAK, 10.0, 0.3, 1.0), cause(BIAS, 3.0, 0.3, 0.5)]) == "warning"
    assert severity([cause(BIAS, 1.0, 0.8, 0.1)]) == "note"
    assert severity([]) == "warning"


def test_classes_come_back_and_others_are_refused():
    assert class_of(BIAS.to_dict(), "x") == BIAS
    for change in (
        {"sizes": [1.0] * 99},
        {"sizes": [float("nan")]},
        {"at_fault": "moon"},
        {"words": "x" * 999},
        {"unit": 3},
    ):
        with pytest.raises(DataError, match="x: "):
            class_of(BIAS.to_dict() | change, "x")
    with pytest.raises(DataError, match="no fault class"):
        class_of({"kind": "a"}, "x")


def test_every_fault_is_a_class_at_each_site_and_of_each_sign():
    classes = fault_classes()
    assert len({fault.name for fault in classes}) == len(classes)
    assert {fault.at_fault for fault in classes} == {"sensor", "machine"}
    biases = [fault for fault in classes if fault.kind == "pilot_bias"]
    assert len(biases) == 24


def test_pairs_that_are_confused_are_listed_with_the_sensor_that_parts_them():
    rng = np.random.default_rng(1)
    truth = np.repeat(np.arange(3), 30)
    probabilities = np.full((90, 3), 0.02)
    # The first two are a coin's throw; the third is always right.
    probabilities[truth == 2, 2] = 0.96
    coin = rng.random(60) < 0.5
    probabilities[:60, 0], probabilities[:60, 1] = np.where(coin, 0.6, 0.38), np.where(coin, 0.38, 0.6)
    noise = rng.normal(size=(90, 1))
    sensors = {"PumpPressure_1": noise + 8.0 * (truth == 1)[:, None], "OilTemperature": noise}
    (pair,) = confusions(("a", "b", "c"), probabilities, truth, sensors)
    assert (pair.first, pair.second, pair.sensor) == ("a", "b", "PumpPressure_1")
    assert 0.35 < pair.error < 0.65
    assert pair.sensor_error < 0.05
    (pair,) = confusions(("a", "b", "c"), probabilities, truth, {"OilTemperature": noise})
    assert pair.sensor == ""
    assert pair.sensor_error is None
