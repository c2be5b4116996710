"""Alarms of a fault that stays are told as one change."""

from edp.monitor.alarms import MonitorAlarm, episodes
from edp.monitor.diagnosis.causes import NONE_OF_THESE, Cause


def alarm(raised_s, *causes, recording="a", residual="virtual:x"):
    evidence = ((f"{residual}.mean", 4.0),)
    return MonitorAlarm(recording, raised_s, raised_s - 1.0, "cusum 1", 9.0, 8.0, evidence, causes)


def blamed(component, kind="velocity_bias"):
    return Cause(kind=kind, component=component, probability=0.9)


def test_alarms_that_name_one_component_are_one_change_whatever_came_between():
    boom, arm = blamed("sensor of boom velocity"), blamed("arm cylinder", "friction")
    raised = [alarm(30.0, boom), alarm(10.0, boom), alarm(20.0, arm), alarm(5.0, boom, recording="b")]
    times = [[one.raised_s for one in change] for change in episodes(raised)]
    assert times == [[10.0, 30.0], [20.0], [5.0]]


def test_without_a_named_cause_the_residual_that_deviates_most_decides():
    unknown = blamed("", NONE_OF_THESE)
    raised = [alarm(1.0), alarm(2.0, unknown), alarm(3.0, residual="balance:s-v")]
    assert [len(change) for change in episodes(raised)] == [2, 1]
    # A summary's own points do not end the name of its residual.
    assert len(episodes([alarm(1.0, residual="v1.5"), alarm(2.0, residual="v1.6")])) == 2
    assert episodes([]) == []
