"""Recordings in, a judged model out, run tick by tick: ``python examples/quickstart.py DATA RUN``."""

import sys

import edp
from edp.report import build_report


def main(data: str, run: str, settings: dict[str, object] | None = None) -> None:
    recordings = edp.read(data)
    targets = ["CylVels_1", "CylVels_2", "CylVels_3"]
    model = edp.train(recordings, targets=targets, horizons=[10], out=run, settings=settings)
    print(model.evaluate())
    print("report:", build_report(run))

    stream = model.stream()
    for row in recordings[0].select(model.inputs)[:100]:
        tick = stream.step(row)  # prediction (horizon, target), intervals, status
    print("after 1 s:", dict(zip(model.targets, tick.prediction[0].tolist(), strict=True)), "m/s, 100 ms ahead")


if __name__ == "__main__":
    main(*sys.argv[1:])
