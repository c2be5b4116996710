"""Recordings in and out: readers and writers, units, time stamps, repairs and quality reports."""

from edp.logs.detect import format_for, list_suffixes, open_log
from edp.logs.formats import csv as csv
from edp.logs.formats import mat as mat
from edp.logs.formats import mdf as mdf
from edp.logs.formats import parquet as parquet
from edp.logs.formats import rosbag as rosbag
from edp.logs.formats.base import FORMATS, TRUTH_PLACES, LogFormat, RawLog, RawSignal, WriteOptions
from edp.logs.formats.mat_layouts import LAYOUTS
from edp.logs.formats.mdf_events import LogEvent
from edp.logs.quality.checks import Finding
from edp.logs.quality.cross_recording import DataQuality, compare
from edp.logs.quality.inspection import inspect_log, look_into
from edp.logs.quality.quality import ChannelFacts, ClockFacts, QualityReport, inspect
from edp.logs.quality.repeats import Repeat, find_repeats
from edp.logs.quality.sketches import Sketch, sketch
from edp.logs.read import (
    common_channels,
    find_recordings,
    read_data_set,
    read_parts,
    read_recording,
    read_truth,
    unique_names,
)
from edp.logs.repair import Repair, split_at_gaps
from edp.logs.write import truth_path, write_recording, write_with_events

__all__ = [
    "FORMATS",
    "LAYOUTS",
    "TRUTH_PLACES",
    "ChannelFacts",
    "ClockFacts",
    "DataQuality",
    "Finding",
    "LogEvent",
    "LogFormat",
    "QualityReport",
    "RawLog",
    "RawSignal",
    "Repair",
    "Repeat",
    "Sketch",
    "WriteOptions",
    "common_channels",
    "compare",
    "find_recordings",
    "find_repeats",
    "format_for",
    "inspect",
    "inspect_log",
    "list_suffixes",
    "look_into",
    "open_log",
    "read_data_set",
    "read_parts",
    "read_recording",
    "read_truth",
    "sketch",
    "split_at_gaps",
    "truth_path",
    "unique_names",
    "write_recording",
    "write_with_events",
]
