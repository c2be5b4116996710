import dataclasses
import signal
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest
import torch

from edp.data.augment import AUGMENTATIONS
from edp.data.chunks import ChunkSpec
from edp.errors import StorageError
from edp.networks.cells import CELLS
from edp.networks.initial import INITIAL_STATES
from edp.networks.losses import LOSSES, TERMS, AdaptiveWeights
from edp.networks.outputs import OUTPUTS
from edp.storage.runs import KeyedRun, Run, run_key
from edp.training.averages import AVERAGES
from edp.training.checkpoint import FILE
from edp.training.eager import EagerAdamW, EagerSgd
from edp.training.fit import fit
from edp.training.optimizers import OPTIMIZERS
from edp.training.schedules import Plateau

pytestmark = pytest.mark.long

KEY = "k" * 32
UPDATES = 10


class Stop(Exception):
    """Raised in place of Ctrl-C."""


def stop_after(epochs):
    def on_event(event):
        if event.row and event.epoch == epochs:
            raise Stop

    return on_event


def assert_same(one, other):
    for (name, mine), theirs in zip(one.predictor.named_parameters(), other.predictor.parameters(), strict=True):
        assert torch.equal(mine, theirs), name

    def facts(fitted):
        return [{key: value for key, value in row.items() if key != "seconds"} for row in fitted.history]

    assert facts(one) == facts(other)


@pytest.fixture(scope="module")
def tiny_training(tiny_training):
    """Fewer updates an epoch: bits are compared, not errors."""
    return dataclasses.replace(tiny_training, updates=UPDATES)


@pytest.fixture(scope="module")
def uninterrupted(tiny, tiny_model, tiny_training):
    return fit(tiny, tiny_model, tiny_training)


@pytest.mark.parametrize("stops", [(2,), (1, 3, 4)])
def test_a_stopped_training_goes_on_to_the_same_bits(stops, tmp_path, tiny, tiny_model, tiny_training, uninterrupted):
    for epoch in stops:
        with Run(tmp_path) as folder, pytest.raises(Stop):
            fit(tiny, tiny_model, tiny_training, KeyedRun(folder, KEY), stop_after(epoch))
    with Run(tmp_path) as folder:
        resumed = fit(tiny, tiny_model, tiny_training, KeyedRun(folder, KEY))
    assert resumed.resumed_at == stops[-1]
    assert_same(resumed, uninterrupted)
    assert len((tmp_path / "history.jsonl").read_text().splitlines()) == tiny_training.epochs


@pytest.mark.parametrize(
    ("mine", "theirs", "options"),
    [
        (EagerAdamW, torch.optim.AdamW, {"lr": 0.1, "fused": True}),
        (EagerAdamW, torch.optim.AdamW, {"lr": 0.1, "fused": False, "weight_decay": 0.3}),
        (EagerSgd, torch.optim.SGD, {"lr": 0.1, "momentum": 0.9}),
    ],
)
def test_optimizers_without_the_compiler_step_to_the_same_bits(mine, theirs, options):
    results, called = [], []
    for kind in (mine, theirs):
        weights = torch.nn.Parameter(torch.linspace(-1, 1, 7))
        optimizer = kind([weights], **options)
        optimizer.register_step_post_hook(lambda stepped, *_: called.append(type(stepped)))
        for power in (2, 3, 4):
            optimizer.zero_grad()
            (weights**power).sum().backward()
            optimizer.step()
        results.append((weights.detach().clone(), optimizer.state_dict()["state"][0]))
    assert torch.equal(results[0][0], results[1][0])
    assert not torch.equal(results[0][0], torch.linspace(-1, 1, 7))
    for name, value in results[1][1].items():
        torch.testing.assert_close(results[0][1][name], value, rtol=0, atol=0)
    assert called == [mine] * 3 + [theirs] * 3


@pytest.mark.parametrize("optimizer", list(OPTIMIZERS))
def test_optimizers_schedules_with_memory_and_fixed_by_passes_go_on_too(
    optimizer, tmp_path, tiny, tiny_bypass, tiny_training
):
    fixed = dataclasses.replace(tiny_bypass.blocks[1], trainable=False)
    model = dataclasses.replace(tiny_bypass, blocks=(tiny_bypass.blocks[0], fixed))
    spec = dataclasses.replace(
        tiny_training, optimizer=OPTIMIZERS[optimizer](), schedule=Plateau(patience=0, threshold=0.5), epochs=4
    )
    with Run(tmp_path) as folder, pytest.raises(Stop):
        fit(tiny, model, spec, KeyedRun(folder, KEY), stop_after(2))
    with Run(tmp_path) as folder:
        assert_same(fit(tiny, model, spec, KeyedRun(folder, KEY)), fit(tiny, model, spec))


RECURRENT = {
    **{name: {"cell": CELLS[name](), "zoneout": 0.2 if CELLS[name].zoneout else 0.0} for name in CELLS},
    **{f"from {name}": {"initial": INITIAL_STATES[name]()} for name in INITIAL_STATES if name != "zero"},
}


@pytest.mark.parametrize("name", RECURRENT)
def test_recurrent_layers_learn_and_go_on_to_the_same_bits(name, tmp_path, tiny, tiny_model, tiny_training):
    model = dataclasses.replace(tiny_model, backbone=dataclasses.replace(tiny_model.backbone, **RECURRENT[name]))
    spec = dataclasses.replace(tiny_training, epochs=3, updates=3 * UPDATES)  # that it learns is seen, too
    with Run(tmp_path) as folder, pytest.raises(Stop):
        fit(tiny, model, spec, KeyedRun(folder, KEY), stop_after(1))
    with Run(tmp_path) as folder:
        resumed, whole = fit(tiny, model, spec, KeyedRun(folder, KEY)), fit(tiny, model, spec)
    assert_same(resumed, whole)
    losses = [row["train_loss"] for row in whole.history]
    assert losses[-1] < losses[0]


WINDOWS = ChunkSpec(regime="window", length=10, batch=9, consecutive=3)
KINDS = {
    **{f"{name} on chunks": {"augmentations": (AUGMENTATIONS[name](),)} for name in AUGMENTATIONS},
    **{f"{name} on windows": {"augmentations": (AUGMENTATIONS[name](),), "chunks": WINDOWS} for name in AUGMENTATIONS},
    **{name: {"average": AVERAGES[name]()} for name in AVERAGES},
    "swa throughout": {"average": AVERAGES["swa"](fraction=0.7, lr_ratio=0.0)},
    "adaptive weights": {"adaptive": AdaptiveWeights(blend=0.5), "horizon_decay": 0.5},
    "terms": {"terms": tuple(TERMS[name]() for name in TERMS)},
    "terms on windows": {"terms": tuple(TERMS[name]() for name in TERMS), "chunks": WINDOWS},
}


@pytest.fixture(scope="module")
def plain(tiny, tiny_model, tiny_training):
    """Validation scores of a training without any of `KINDS`, on chunks and on windows."""

    @cache
    def scores(chunks):
        spec = dataclasses.replace(tiny_training, epochs=3, updates=10, chunks=chunks)
        return [row["validation_score"] for row in fit(tiny, tiny_model, spec).history]

    return scores


@pytest.mark.parametrize("kind", KINDS)
def test_every_way_to_train_goes_on_to_the_same_bits(kind, tmp_path, tiny, tiny_model, tiny_training, plain):
    spec = dataclasses.replace(tiny_training, epochs=3, updates=10, **KINDS[kind])
    with Run(tmp_path) as folder, pytest.raises(Stop):
        fit(tiny, tiny_model, spec, KeyedRun(folder, KEY), stop_after(2))
    with Run(tmp_path) as folder:
        resumed = fit(tiny, tiny_model, spec, KeyedRun(folder, KEY))
    assert resumed.resumed_at == 2
    whole = fit(tiny, tiny_model, spec)
    assert_same(resumed, whole)
    same = plain(spec.chunks) == [row["validation_score"] for row in whole.history]
    assert same == (kind == "ema")  # no option that does nothing


@pytest.mark.parametrize("output", ["quantiles", "normal"])
def test_calibration_is_repeated_to_the_same_bits(output, tmp_path, tiny, tiny_model, tiny_training):
    model = dataclasses.replace(tiny_model, output=OUTPUTS[output]())
    loss = next(LOSSES[name]() for name in LOSSES if output in LOSSES[name].outputs)
    spec = dataclasses.replace(tiny_training, epochs=2, updates=10, loss=loss)
    found = []
    for _ in range(2):
        with Run(tmp_path) as folder:
            found.append(fit(tiny, model, spec, KeyedRun(folder, KEY)).predictor.output.stretch)
    assert torch.equal(*found)
    assert not torch.equal(found[0], torch.ones_like(found[0]))


def test_a_finished_training_is_not_done_again(tmp_path, tiny, tiny_model, tiny_training, uninterrupted):
    for _ in range(2):
        with Run(tmp_path) as folder:
            again = fit(tiny, tiny_model, tiny_training, KeyedRun(folder, KEY))
    assert again.resumed_at == tiny_training.epochs
    assert_same(again, uninterrupted)


KILLED = """
import dataclasses, os, runpy, signal, sys
tiny = runpy.run_path(sys.argv[1])
from edp.storage.runs import KeyedRun, Run
from edp.training.fit import fit
fsync, writes = os.fsync, []
def die(handle):
    writes.append(handle)
    # Two files an epoch: the fifth is the third checkpoint, of which half is on the disk.
    if len(writes) == 5:
        # Neither is needed to train, and each takes a second to load.
        assert not {"torch._dynamo", "numba"} & set(sys.modules)
        os.ftruncate(handle, os.fstat(handle).st_size // 2)
        os.kill(os.getpid(), signal.SIGKILL)
    fsync(handle)
os.fsync = die
spec = dataclasses.replace(tiny["TRAINING"], updates=int(sys.argv[3]))
fit(tiny["prepared"](), tiny["MODEL"], spec, KeyedRun(Run(sys.argv[2]), "k" * 32))
"""


@pytest.mark.processes
def test_a_process_killed_while_it_writes_a_checkpoint_goes_on_to_the_same_bits(
    tmp_path, tiny, tiny_model, tiny_training, uninterrupted
):
    helper = Path(__file__).with_name("conftest.py")
    command = [sys.executable, "-c", KILLED, helper, tmp_path, str(UPDATES)]
    done = subprocess.run(command, check=False, capture_output=True)
    assert done.returncode == -signal.SIGKILL, done.stderr.decode()
    with Run(tmp_path) as folder:
        resumed = fit(tiny, tiny_model, tiny_training, KeyedRun(folder, KEY))
    assert resumed.resumed_at == 2
    assert_same(resumed, uninterrupted)


@pytest.fixture
def half_done(tmp_path, tiny, tiny_model, tiny_training):
    with Run(tmp_path) as folder, pytest.raises(Stop):
        fit(tiny, tiny_model, tiny_training, KeyedRun(folder, KEY), stop_after(1))
    return tmp_path


@pytest.mark.parametrize("kept", [0, 4, 0.3, 0.99])
def test_a_truncated_checkpoint_is_refused(kept, half_done, tiny, tiny_model, tiny_training):
    file = half_done / FILE
    data = file.read_bytes()
    file.write_bytes(data[: kept if isinstance(kept, int) else int(kept * len(data))])
    with Run(half_done) as folder, pytest.raises(StorageError, match=r"is damaged .* remove it to train"):
        fit(tiny, tiny_model, tiny_training, KeyedRun(folder, KEY))


def test_a_checkpoint_of_another_run_is_refused(half_done, tiny, tiny_model, tiny_training):
    with Run(half_done) as folder, pytest.raises(StorageError, match="belongs to another run"):
        fit(tiny, tiny_model, tiny_training, KeyedRun(folder, "other"))


def test_a_locked_run_folder_names_its_holder(tmp_path):
    with Run(tmp_path), pytest.raises(StorageError, match=r"in use by process \d+"):
        Run(tmp_path)
    with Run(tmp_path):
        """The lock is free again."""


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="cannot create folder"):
        Run(tmp_path / "file" / "run")


def test_a_lock_that_cannot_be_opened_is_a_storage_error(tmp_path):
    (tmp_path / ".lock").mkdir()
    with pytest.raises(StorageError, match=r"lock.*is not a lock file"):
        Run(tmp_path)


def test_a_folder_is_bound_to_one_run(tmp_path):
    with Run(tmp_path) as folder:
        assert not folder.claim("a", "text = 1\n")
        assert folder.claim("a", "text = 1\n")
        with pytest.raises(StorageError, match="holds another run"):
            folder.claim("b", "text = 2\n")
    assert (tmp_path / "config.toml").read_text() == "text = 1\n"


def test_run_keys_depend_on_settings_and_data_and_not_on_their_order():
    key = run_key({"a": 1, "b": [2]}, "d")
    assert key == run_key({"b": [2], "a": 1}, "d")
    assert len({key, run_key({"a": 1, "b": [3]}, "d"), run_key({"a": 1, "b": [2]}, "e")}) == 3


@pytest.mark.parametrize("refit", ["best", "whole"])
@pytest.mark.parametrize("stop", [(False, 2), (True, 1)])
def test_a_stopped_refit_goes_on_to_the_same_bits(refit, stop, tmp_path, tiny, tiny_model, tiny_training):
    spec = dataclasses.replace(tiny_training, epochs=3, refit=refit)

    def on_event(event):
        if (event.refit, event.update) == (stop[0], event.updates) and event.epoch == stop[1]:
            raise Stop

    with Run(tmp_path) as folder, pytest.raises(Stop):
        fit(tiny, tiny_model, spec, KeyedRun(folder, KEY), on_event)
    with Run(tmp_path) as folder:
        assert_same(fit(tiny, tiny_model, spec, KeyedRun(folder, KEY)), fit(tiny, tiny_model, spec))
