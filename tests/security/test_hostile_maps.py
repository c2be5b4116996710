"""Signal maps with numbers and names that nothing can mean."""

from __future__ import annotations

import math
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from edp.errors import ConfigError
from edp.logs import find_recordings
from edp.signals import ChannelMap, SignalMap

BAD = [math.inf, -math.inf, math.nan, 0.0, -1.0, 1e300]


@pytest.mark.parametrize("value", BAD)
@pytest.mark.parametrize("key", ["sample_time_s", "rate_hz"])
def test_steps_and_rates_are_finite_and_positive(key, value):
    with pytest.raises(ConfigError, match=f"{key} = "):
        SignalMap(**{key: value})


@pytest.mark.parametrize("delimiter", [";;", "", '"', "\n", "\r", "\0"])
def test_a_delimiter_is_one_character(delimiter):
    with pytest.raises(ConfigError, match="give one character"):
        SignalMap(delimiter=delimiter)


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("key", ["constant", "scale"])
def test_constants_and_scales_are_finite(key, value):
    with pytest.raises(ConfigError, match=f"{key} = "):
        SignalMap((ChannelMap("a", "a", **{key: value}),))


@pytest.mark.parametrize("text", ["n" * 10_000, "a\x1b[31m", "a\nb", "a\0b"])
@pytest.mark.parametrize("key", ["name", "column", "description"])
def test_names_are_short_and_plain(key, text):
    entry = {"name": "a", "column": "a"} | {key: text}
    with pytest.raises(ConfigError, match="signal map, channel") as refused:
        SignalMap((ChannelMap(**entry),))
    assert str(refused.value).isprintable()
    assert len(str(refused.value)) < 600


def test_many_channels_are_compared_at_once():
    with pytest.raises(ConfigError, match="names channel"):
        SignalMap(tuple(ChannelMap(f"c{i % 49_999}", "c") for i in range(50_000)))


def test_what_is_no_log_is_passed_over_in_a_folder(tmp_path):
    table = pa.table({"time": np.arange(50) / 50, "BmUp": np.zeros(50)})
    pq.write_table(table, tmp_path / "a.parquet")
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "folder.mat").mkdir()
    (tmp_path / "loop.csv").symlink_to(tmp_path / "loop.csv")
    assert find_recordings(tmp_path) == (tmp_path / "a.parquet",)
