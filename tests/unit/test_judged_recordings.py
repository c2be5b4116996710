"""Scores of recordings hold what the verdict compares, so that a verdict on several outputs has an interval."""

from dataclasses import replace

import numpy as np

from edp.evaluation.guard import network_verdict
from edp.evaluation.ruler import Ruler


def test_scores_by_recording_give_the_verdict_an_interval(tiny):
    ruler = Ruler(tiny, 0)
    truth = [(number, ruler.truth(number) / ruler.factors) for number in range(len(tiny.test))]
    rng = np.random.default_rng(0)

    def model(label, error):
        noisy = [(number, values + error * rng.standard_normal(values.shape)) for number, values in truth]
        return replace(ruler.measure(noisy), label=label)

    scores = ruler.file({"network": model("network", 0.1), "other": model("other", 0.4)}, ())
    for recording in scores.models["network"].recordings.values():
        for errors in recording.values():
            assert all({"mae", "rmse"} <= errors[name].keys() for name in tiny.task.targets)
    verdict = network_verdict(scores)
    assert verdict.recordings == len({part.name.partition("[")[0] for part in tiny.test})
