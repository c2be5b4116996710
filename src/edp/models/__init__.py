"""Networks on the streaming contract: backbones, heads, activations and the predictor that joins them."""

from edp.models.adapted import AdaptedStream
from edp.models.predictor import ModelSpec, Predictor, build_model
from edp.models.running import stream_predictions
from edp.models.stream import Stream, StreamStatus, StreamTick

__all__ = [
    "AdaptedStream",
    "ModelSpec",
    "Predictor",
    "Stream",
    "StreamStatus",
    "StreamTick",
    "build_model",
    "stream_predictions",
]
