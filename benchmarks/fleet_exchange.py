"""What an exchange of gradients between two processes takes (torch gloo, an all-reduce), beside a training step."""

from __future__ import annotations

import multiprocessing
import socket
import time
from multiprocessing.queues import Queue
from typing import Any

import numpy as np

EXCHANGES = 400


def _exchange(rank: int, port: int, numbers: int, answers: Queue[dict[str, Any]]) -> None:
    import torch
    from torch import distributed

    torch.set_num_threads(1)
    distributed.init_process_group("gloo", f"tcp://127.0.0.1:{port}", world_size=2, rank=rank)
    gradient = torch.full((numbers,), float(rank))
    distributed.all_reduce(gradient)
    if float(gradient[0]) != 1.0:
        raise SystemExit("the sum of two ranks is wrong")
    wall, began = [], time.process_time()
    for _ in range(EXCHANGES):
        distributed.barrier()  # both begin at once: what is waited for the other's step is no part of it
        start = time.perf_counter()
        distributed.all_reduce(gradient)
        wall.append(1e3 * (time.perf_counter() - start))
    spent = 1e3 * (time.process_time() - began) / EXCHANGES
    distributed.destroy_process_group()
    if rank == 0:
        quarter, median = np.quantile(wall, (0.25, 0.5))
        answers.put({
            "numbers": numbers,
            "least_ms": min(wall),
            "quartile_ms": float(quarter),
            "median_ms": float(median),
            "processor_ms": spent,
        })  # fmt: skip


def exchange_ms(numbers: int) -> dict[str, Any]:
    """Wall time of an all-reduce of so many single-precision numbers, and processor time of it with its barrier."""
    context = multiprocessing.get_context("spawn")
    answers = context.Queue()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    processes = [context.Process(target=_exchange, args=(rank, port, numbers, answers)) for rank in (0, 1)]
    for process in processes:
        process.start()
    try:
        found: dict[str, Any] = answers.get(timeout=300)
    finally:
        for process in processes:
            process.join(30)
            process.kill()
    return found
