"""Scores of free runs with stated errors of one velocity and of strokes by time."""

from edp.evaluation.free_run_file import (
    ChannelErrors,
    ErrorLine,
    FreeRunErrors,
    FreeRunScores,
    HorizonErrors,
    PressureErrors,
    RunSummary,
    StrokeErrors,
)


def sample_errors(velocity, *strokes, times=None):
    """Errors of the velocity 'v' and of the stroke 'boom' after 1, 2, ... seconds, or at other times."""
    return FreeRunErrors(
        velocity_mae=ChannelErrors(unit="mm/s", by_channel={"v": velocity}, mean=velocity),
        stroke_error=tuple(
            StrokeErrors(at_s=float(at), unit="mm", by_channel={"boom": error}, mean=error, median=error)
            for at, error in zip(times or range(1, len(strokes) + 1), strokes, strict=True)
        ),
        pressure_nrmse=PressureErrors(mean=None, by_channel={}),
        diverged=0.0,
    )


def sample_free_run_scores(errors, by_recording=None):
    """Scores with these errors over all runs, and errors by recording."""
    line = ErrorLine(unit=None, by_channel={})
    return FreeRunScores(
        runs=1,
        recordings=1,
        seconds=1.0,
        **vars(errors),
        by_horizon=HorizonErrors(seconds=(1.0,), velocities=line, strokes=line, pressures=line),
        by_recording={name: RunSummary(runs=1, **vars(one)) for name, one in (by_recording or {}).items()},
        by_driving={},
        situations={},
    )
