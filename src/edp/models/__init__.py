"""Networks on the streaming contract: backbones, heads, activations and the predictor that joins them."""

from edp.models.adapted import AdaptedStream
from edp.models.predictor import ModelSpec, Predictor, build_model
from edp.models.running import Stream, stream_predictions

__all__ = ["AdaptedStream", "ModelSpec", "Predictor", "Stream", "build_model", "stream_predictions"]
