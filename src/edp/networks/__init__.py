"""Networks on the streaming contract: backbones, heads, activations and the predictor that joins them."""

from edp.networks.adapted import AdaptedStream
from edp.networks.predictor import ModelSpec, Predictor, build_model
from edp.networks.running import stream_predictions
from edp.networks.stream import Stream, StreamStatus, StreamTick

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
