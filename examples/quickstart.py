"""Recordings in, a judged model out, run tick by tick: ``python examples/quickstart.py DATA RUN``."""

import sys

from edp.config.experiment import load_experiment
from edp.networks import Stream
from edp.training import load_bundle
from edp.workflows.train_evaluate import DataSource, build_report, evaluate, train


def main(data: str, run: str, *changes: str) -> None:
    source = DataSource.of(data)
    train(source, load_experiment(preset="quick", overrides=changes), run)
    evaluate(run, baselines=["persistence", "ridge_arx"])
    print("report:", build_report(run))

    bundle = load_bundle(run)
    stream = Stream(bundle.predictor)
    names = [channel.name for channel in bundle.inputs]
    for row in source.read()[0].select(names)[:100]:
        tick = stream.step(row)  # prediction (horizon, target), intervals, status
    print("after 1 s:", dict(zip(bundle.task.targets, tick.prediction[0].tolist(), strict=True)), "m/s, 100 ms ahead")


if __name__ == "__main__":
    main(*sys.argv[1:])
