"""How many samples a second does training process, beside a plain PyTorch loop, and does its cost grow with the data?

The rival is what a user would write: `nn.Conv1d` with weight norm, `nn.LSTM` and attention over every window of 50
samples, windows drawn by a shuffling `DataLoader`, Adam, Huber loss; the same network, parameter for parameter. A
sample is a prediction that is trained: a window there, a tick with a loss here. Beside it, without a verdict, the
rivals that know more: the same loop on long sequences, and ours on windows. One thread, processor time.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm
from torch.utils.data import DataLoader, Dataset

from common import finish, parser, table, verdict
from edp.config.experiment import load_experiment
from edp.data.chunks import ChunkSampler, ChunkSpec
from edp.data.prepared import Prepared
from edp.networks.predictor import build_model
from edp.networks.streaming import parameters_of
from edp.training import fit
from edp.training.optimizers import AdamW
from edp.workflows.train_evaluate import DataSource, SimulationOrder, prepare_data, simulate_data_set

WINDOW, KERNEL, UNITS, BURN_IN = 50, 5, 64, 50


class PlainHybrid(nn.Module):
    """The default hybrid written with PyTorch's own layers, ``(batch, time, feature)`` to ``(batch, time, 3)``.

    With `last` only the last tick's prediction is made, ``(batch, 3)``.
    """

    def __init__(self, features: int) -> None:
        super().__init__()
        self.first = weight_norm(nn.Conv1d(features, UNITS, KERNEL))
        self.second = weight_norm(nn.Conv1d(UNITS, UNITS, KERNEL))
        self.shortcut = nn.Conv1d(features, UNITS, 1)
        self.lstm = nn.LSTM(UNITS, UNITS, batch_first=True)
        self.score = nn.Linear(UNITS, 1)
        self.heads = nn.ModuleList(
            nn.Sequential(nn.Linear(3 * UNITS, 32), nn.ReLU(), nn.Linear(32, 1)) for _ in range(3)
        )

    def forward(self, x: Tensor, last: bool) -> Tensor:
        x = x.transpose(1, 2)
        y = torch.relu(self.first(nn.functional.pad(x, (KERNEL - 1, 0))))
        y = torch.relu(self.second(nn.functional.pad(y, (KERNEL - 1, 0)))) + self.shortcut(x)
        h, _ = self.lstm(y.transpose(1, 2))
        scores = self.score(h).squeeze(-1)
        if last:
            pooled = (scores.softmax(dim=1).unsqueeze(-1) * h).sum(dim=1)
            now, difference = h[:, -1], h[:, -1] - h[:, -2]
        else:
            ticks = torch.arange(h.shape[1])
            lag = ticks[:, None] - ticks
            outside = (lag < 0) | (lag >= WINDOW)
            pooled = scores.unsqueeze(1).masked_fill(outside, -torch.inf).softmax(dim=-1) @ h
            now, difference = h, h - nn.functional.pad(h, (0, 0, 1, 0))[:, :-1]
        shared = torch.cat([pooled, now, difference], dim=-1)
        return torch.cat([head(shared) for head in self.heads], dim=-1)


class Windows(Dataset[tuple[Tensor, Tensor]]):
    """Windows of `length` ticks, one every `stride`, with their targets, as the usual data set class has them."""

    def __init__(self, parts: list[tuple[Tensor, Tensor]], length: int, stride: int, every_tick: bool) -> None:
        self.parts, self.length, self.every_tick = parts, length, every_tick
        self.index = [
            (number, start) for number, (x, _) in enumerate(parts) for start in range(0, len(x) - length + 1, stride)
        ]

    def __len__(self) -> int:
        return len(self.index)

    def __getitem__(self, item: int) -> tuple[Tensor, Tensor]:
        number, start = self.index[item]
        x, y = self.parts[number]
        stop = start + self.length
        return x[start:stop], y[start:stop] if self.every_tick else y[stop - 1]


def standardised(data: Prepared, model: Any) -> list[tuple[Tensor, Tensor]]:
    """Scaled features and targets of the training recordings, computed once, outside the time taken."""
    net, parts = build_model(data.task, model, data.scaler(), 0), []
    with torch.no_grad():
        for part in data.train:
            ticks = part.samples - data.task.max_horizon
            x = torch.from_numpy(part.inputs[:ticks]).unsqueeze(0)
            features, _ = net.front(x, net.front.initial_state(1, x))
            future = np.stack([part.targets[k : k + ticks] for k in data.task.horizons], axis=1)
            targets = net.code.encode(torch.from_numpy(future).unsqueeze(0), features)
            parts.append((net.front.scale(features)[0].contiguous(), targets[0, :, 0].contiguous()))
    return parts


def batches(loader: DataLoader[Any]) -> Iterator[tuple[Tensor, Tensor]]:
    while True:
        yield from loader


def plain_rate(net: PlainHybrid, loader: DataLoader[Any], every_tick: bool, seconds: float) -> float:
    """Samples per processor second of the plain loop, after a few updates to warm up."""
    optimizer, loss_of = torch.optim.Adam(net.parameters(), lr=1e-3), nn.HuberLoss(delta=1.5)
    net.train()
    samples, began = 0, time.process_time()
    for number, (x, y) in enumerate(batches(loader)):
        if number == 5:
            samples, began = 0, time.process_time()
        optimizer.zero_grad()
        prediction = net(x, last=not every_tick)
        if every_tick:
            prediction, y = prediction[:, BURN_IN:], y[:, BURN_IN:]
        loss = loss_of(prediction, y)
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimizer.step()
        samples += y.shape[0] * (y.shape[1] if every_tick else 1)
        if number >= 5 and time.process_time() - began > seconds:
            break
    return samples / (time.process_time() - began)


def our_rate(data: Prepared, model: Any, training: Any, seconds: float) -> float:
    """Samples per processor second of `fit`: a longer training less a shorter one, so that start and end cancel."""
    few = 5
    short, probe = (processor_seconds(data, model, training, count) for count in (few, 3 * few))
    each = max((probe - short) / (2 * few), 1e-3)
    many = few + max(few, round(seconds / each))
    spent = processor_seconds(data, model, training, many) - short
    return samples_between(data, training, few, many) / spent


def processor_seconds(data: Prepared, model: Any, training: Any, updates: int) -> float:
    began = time.process_time()
    fit(data, model, replace(training, epochs=1, updates=updates))
    return time.process_time() - began


def samples_between(data: Prepared, training: Any, first: int, last: int) -> int:
    """Ticks with a loss in the updates from `first` to `last` of an epoch."""
    sampler = ChunkSampler(data.train, data.task.horizons, training.chunks, training.seed)
    drawn = itertools.chain.from_iterable(sampler.epoch(number) for number in itertools.count())
    return sum(batch.targets_seen for batch in itertools.islice(drawn, first, last))


def seconds_per_sample(data: Prepared, model: Any, training: Any) -> float:
    """Processor seconds of one whole pass over the training data, for each tick with a loss, without start and end."""
    updates = ChunkSampler(data.train, data.task.horizons, training.chunks, training.seed).updates()
    spent = [processor_seconds(data, model, training, count) for count in (1, 1, updates)]
    return (spent[2] - spent[1]) / samples_between(data, training, 1, updates)


def main() -> None:
    arguments = parser(__doc__ or "").parse_args()
    quick = arguments.quick
    seconds = 1.0 if quick else 12.0
    minutes, recordings = (3.0, 6) if quick else (24.0, 24)
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as temporary:
        source = arguments.data or Path(temporary) / "data"
        simulate_data_set(source, SimulationOrder(minutes=minutes, recordings=recordings, seed=arguments.seed))
        experiment = load_experiment(None, "quick", [f"training.seed={arguments.seed}"])
        data = prepare_data(DataSource.of(source), experiment)
    model, training = experiment.model, replace(experiment.training, patience=0, threads=1)
    long = replace(training, chunks=ChunkSpec(regime="chunk", length=128, batch=16, burn_in=BURN_IN))
    windows = replace(training, chunks=ChunkSpec(regime="window", length=WINDOW, batch=64), optimizer=AdamW())
    torch.manual_seed(arguments.seed)
    parts = standardised(data, model)
    plain = PlainHybrid(len(data.task.features.features))
    ours = parameters_of(build_model(data.task, model, data.scaler(), 0))
    if parameters_of(plain) != ours:
        raise SystemExit(f"the networks differ: {parameters_of(plain)} parameters against {ours}")
    single = DataLoader(Windows(parts, WINDOW, 1, every_tick=False), batch_size=64, shuffle=True)
    pieces = DataLoader(Windows(parts, BURN_IN + 128, 128, every_tick=True), batch_size=16, shuffle=True)
    processor_seconds(data, model, training, 3)  # loads what the first training loads
    rates = {
        "ours, chunks, preset quick (SOAP)": our_rate(data, model, training, seconds),
        "ours, chunks of 16 x 128, SOAP": our_rate(data, model, long, seconds),
        "ours, chunks of 16 x 128, AdamW": our_rate(data, model, replace(long, optimizer=AdamW()), seconds),
        "plain loop over windows, Adam": plain_rate(plain, single, False, seconds),
        "plain loop over sequences of 178, Adam": plain_rate(plain, pieces, True, seconds),
        "ours, windows, AdamW": our_rate(data, model, windows, seconds),
    }
    table(["training", "samples per processor s"], list(rates.items()))
    quarter = replace(data, train=data.train[: max(1, len(data.train) // 4)])
    growth = {
        "a quarter": seconds_per_sample(quarter, model, training),
        "all": seconds_per_sample(data, model, training),
    }
    table(["training data", "us per sample"], [[name, 1e6 * value] for name, value in growth.items()])
    named = list(rates.values())
    verdicts = [
        verdict("samples per s, ours against a plain loop over windows", named[0], named[3], ">= 3", "1/s", quick),
        verdict("cost per sample, all data against a quarter", *reversed(growth.values()), "<= 1.15", "s", quick),
    ]
    finish("training_speed", verdicts, arguments.seed, {"samples_per_s": rates, "s_per_sample": growth})


if __name__ == "__main__":
    main()
