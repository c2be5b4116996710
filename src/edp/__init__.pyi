from edp import testing as testing
from edp.errors import EdpError as EdpError
from edp.monitor.monitor import Monitor as Monitor
from edp.monitor.monitor_file import load_monitor as load_monitor
from edp.networks.stream import Stream as Stream
from edp.recording import Recording as Recording
from edp.training.twin_bundle import load_twin as load_twin
from edp.workflows.api.compare import ComparedRuns as ComparedRuns
from edp.workflows.api.compare import compare as compare
from edp.workflows.api.predictions import Predictions as Predictions
from edp.workflows.api.predictor import TrainedPredictor as TrainedPredictor
from edp.workflows.api.predictor import load as load
from edp.workflows.api.recordings import Recordings as Recordings
from edp.workflows.api.recordings import read as read
from edp.workflows.api.scores import JudgedScores as JudgedScores
from edp.workflows.api.scores import SearchStudy as SearchStudy
from edp.workflows.api.scores import load_study as load_study
from edp.workflows.api.training import train as train

__version__: str
