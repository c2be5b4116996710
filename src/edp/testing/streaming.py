"""The contract of every network: shapes, causality, chunks, resets, streams, gradients, costs, the list of layers."""

from __future__ import annotations

import copy

import numpy as np
import torch
from torch import Tensor

from edp.errors import ConfigError
from edp.evaluation.mac_check import check_counted
from edp.export.golden import random_inputs
from edp.ir.reference import Reference
from edp.networks.predictor import Predictor
from edp.networks.stream import Stream
from edp.networks.streaming import (
    State,
    detach_state,
    indifferent_parameters,
    list_fixed_parameters,
    map_state,
    parameters_of,
    reset_where,
    state_numbers,
)
from edp.networks.trees import Trees
from edp.testing.expectations import ContractError, expect, expect_near
from edp.testing.operations import check_operations

# More ticks than the window, so that rings go round.
TICKS = 24
MACHINE_CONSTANTS = 800
"""Numbers of a machine's geometry that a physics base may add to the list of layers."""


def draw_inputs(predictor: Predictor, batch: int = 2, ticks: int = TICKS, seed: int = 0) -> Tensor:
    """Return random inputs, ``(batch, time, input)``, of the predictor's type."""
    like = next(predictor.parameters())
    draw = torch.Generator().manual_seed(seed)
    return torch.randn(batch, ticks, predictor.front.inputs, generator=draw, dtype=like.dtype)


def run_network(predictor: Predictor, x: Tensor, state: State | None = None) -> tuple[Tensor, State]:
    """Return the standardised predictions and the next state, from reset or from a state; no gradients."""
    with torch.no_grad():
        return predictor(x, predictor.initial_state(len(x), x) if state is None else state)


def check_shapes(predictor: Predictor) -> None:
    """Check shape and type of predictions and state, and that encoding undoes decoding.

    Args:
        predictor: predictor in single precision.

    Raises:
        ContractError: one of them is broken.
    """
    x, task = draw_inputs(predictor), predictor.task
    code, state = run_network(predictor, x)
    with torch.no_grad():
        physical, _ = predictor.predict(x, predictor.initial_state(2, x))
        again = predictor.code.encode(physical, predictor.front(x, predictor.front.initial_state(2, x))[0])
    shape = (2, TICKS, len(task.horizons), len(task.targets))
    for what, values in (("forward", code), ("predict", physical)):
        expect(values.shape == shape, f"{what} gives {tuple(values.shape)}; {shape} must hold")
    expect(code.dtype == x.dtype, f"forward gives {code.dtype} for inputs of {x.dtype}")
    expect(bool(torch.isfinite(code).all()), "forward gives values that are not finite")
    # Encoding and decoding round in single precision.
    expect_near(again, code, "encoding what predict gives is not what forward gives", rtol=1e-4, atol=1e-5)
    fresh = predictor.initial_state(2, x)
    expect(_layout(fresh) == _layout(state), "the state after a run has other shapes or types than the one at reset")
    expect(state_numbers(state) == state_numbers(fresh), "the state grows with the ticks")


def check_causality(predictor: Predictor) -> None:
    """Check that no prediction depends on a later sample, and that the present sample is read.

    Args:
        predictor: predictor in double precision, in evaluation mode.
    """
    x, cut = draw_inputs(predictor), 13
    changed = x.clone()
    # Large changes: a small one could hide in a saturated unit.
    changed[:, cut:] = 50.0 * draw_inputs(predictor, seed=1)[:, cut:]
    before, after = run_network(predictor, x)[0], run_network(predictor, changed)[0]
    # Double precision: what remains is the order of sums, never a leak.
    expect_near(after[:, :cut], before[:, :cut], "a later tick changes an earlier prediction", rtol=0, atol=1e-12)
    expect(not torch.equal(after[:, cut], before[:, cut]), "the present tick does not reach its prediction")


def check_chunks(predictor: Predictor) -> None:
    """Check that single samples, chunks with carried state, and a whole window agree at the last sample.

    Args:
        predictor: predictor in double precision, in evaluation mode.
    """
    window = predictor.spec.window
    # In the usual range: what is far outside may overflow the single precision of a stream, which then restarts.
    x = torch.from_numpy(random_inputs(predictor, window, seed=0)).to(next(predictor.parameters())).unsqueeze(0)
    with torch.no_grad():
        whole, _ = predictor.predict(x, predictor.initial_state(1, x))
        # Four ticks before the end: the boundary lies inside of the window.
        _, state = predictor.predict(x[:, : window - 4], predictor.initial_state(1, x))
        chunk, _ = predictor.predict(x[:, window - 4 :], state)
    stream = Stream(predictor)
    for row in x[0]:
        expect(not stream.warm, "a stream is warm before it has seen a whole window")
        step = stream.step(row)
    expect(stream.warm, "a stream is not warm after a whole window")
    expect_near(chunk[:, -1], whole[:, -1], "a chunk with carried state differs from one run", rtol=0, atol=1e-10)
    # The stream answers in single precision.
    expect_near(step.prediction, whole[0, -1].float(), "a stream differs from one run", rtol=1e-6, atol=1e-7)


def check_reset(predictor: Predictor) -> None:
    """Check that a reset clears the requested streams and leaves the others.

    Args:
        predictor: predictor in double precision, in evaluation mode.
    """
    x, later = draw_inputs(predictor), draw_inputs(predictor, seed=2)
    _, state = run_network(predictor, x)
    mixed = reset_where(torch.tensor([True, False]), predictor.initial_state(2, x), detach_state(state))
    both = run_network(predictor, later, mixed)[0]
    fresh, carried = run_network(predictor, later[:1])[0], run_network(predictor, later, state)[0][1]
    expect_near(both[:1], fresh, "a stream remembers something after its reset", rtol=0, atol=1e-12)
    expect_near(both[1], carried, "a reset of one stream changes another", rtol=0, atol=1e-12)
    # A state that makes no difference is no memory; the part should not carry one.
    forgot = torch.allclose(both[1], run_network(predictor, later)[0][1], rtol=0, atol=1e-6)
    expect(not forgot, "the state that is carried makes no difference")


def check_state_is_left(predictor: Predictor) -> None:
    """Check that a run does not change the state that it was given."""
    _, state = run_network(predictor, draw_inputs(predictor))
    copies = map_state(torch.clone, state)
    run_network(predictor, draw_inputs(predictor, seed=3), state)

    def compare(old: Tensor, new: Tensor) -> Tensor:
        expect(torch.equal(old, new), "a run writes into the state that it was given")
        return old

    map_state(compare, copies, state)


def check_determinism(predictor: Predictor) -> None:
    """Check that evaluation is deterministic, and that training is random if there is dropout.

    Args:
        predictor: predictor in single precision, in evaluation mode.
    """
    x = draw_inputs(predictor)
    first = run_network(predictor, x)[0]
    torch.manual_seed(99)
    # Another state of the generator shows a hidden draw.
    expect(torch.equal(run_network(predictor, x)[0], first), "two evaluations of the same inputs differ")
    other = copy.deepcopy(predictor)
    expect(torch.equal(run_network(other, x)[0], first), "a copy of the network gives another result")
    if getattr(predictor.spec.backbone, "dropout", 0.0):
        expect(not torch.equal(run_network(other.train(), x)[0], first), "dropout does nothing in training")


def check_batch(predictor: Predictor) -> None:
    """Check that parallel streams do not affect each other.

    Args:
        predictor: predictor in double precision, in evaluation mode.
    """
    x = draw_inputs(predictor, batch=4)
    together = run_network(predictor, x)[0]
    for i in range(4):
        alone = run_network(predictor, x[i : i + 1])[0]
        expect_near(together[i : i + 1], alone, "streams of a batch change one another", rtol=0, atol=1e-12)


def check_gradients(predictor: Predictor) -> None:
    """Check that the error reaches every trainable parameter; an untrained skip connection is exempt.

    Args:
        predictor: predictor in double precision.
    """
    torch.manual_seed(5)
    x = draw_inputs(predictor, batch=4)
    code, _ = predictor(x, predictor.initial_state(4, x))
    # An error of the size of a standard deviation, however far a physics base goes on inputs drawn at random.
    # The target is drawn around the answer itself, so that every output has an error.
    loss = (code - code.detach() - torch.randn(code.shape, dtype=code.dtype)).square().sum()
    learned = {name: parameter for name, parameter in predictor.named_parameters() if parameter.requires_grad}
    fixed = {name for name, _ in predictor.named_parameters()} - set(learned)
    expect(
        fixed == list_fixed_parameters(predictor), f"parameters that do not learn: {', '.join(sorted(fixed)) or 'none'}"
    )
    indifferent = indifferent_parameters(predictor)
    gradients = torch.autograd.grad(loss, list(learned.values()), allow_unused=True)
    for name, gradient in zip(learned, gradients, strict=True):
        expect(gradient is not None, f"the error does not reach '{name}'")
        size = float(gradient.abs().sum())
        silent = name in indifferent
        # Numbers far apart: rounding on one side, any real gradient on the other.
        expect(size < 1e-8 if silent else size > 1e-9, f"the gradient of '{name}' adds up to {size:.3g}")


def check_parameters_counted(predictor: Predictor) -> None:
    """Check that the parts count every parameter once, including those that an inference build folds away."""
    rows, named = predictor.costs(), dict(predictor.named_parameters())
    counted, there = sum(row.parameters for row in rows), sum(parameter.numel() for parameter in named.values())
    expect(counted == there, f"the parts count {counted} parameters, the network has {there}")
    # Gains and amplitudes are what an inference build folds away.
    gains = sum(p.numel() for name, p in named.items() if name.endswith((".gain", "activation.free")))
    foldable = sum(row.foldable for row in rows)
    expect(foldable == gains, f"the parts count {foldable} foldable parameters, the network has {gains}")
    empty = [row.part for row in rows if row.width_in <= 0 and row.width_out <= 0]
    expect(not empty, f"rows of costs without a width: {', '.join(empty)}")


def check_work_counted(predictor: Predictor) -> None:
    """Check the multiply-accumulates declared by the parts against a trace of one sample.

    Raises:
        ContractError: a part counts others than it runs, or hides what it multiplies.
    """
    try:
        check_counted(predictor)
    except ConfigError as error:
        raise ContractError(str(error)) from error


def check_graph(predictor: Predictor) -> None:
    """Check that the layer graph for exports computes the same as the network.

    Args:
        predictor: predictor in double precision, with weights that single precision represents exactly.

    Raises:
        ContractError: it means something else.
        ExportError: a part has no form as layers.
    """
    graph = predictor.graph()
    x, expected = _stream_outputs(predictor)
    reference = Reference(graph)
    results = [reference.results(row) for row in x]
    expect(set(results[0]) == set(expected), f"the list gives {sorted(results[0])}; {sorted(expected)} must hold")
    for meaning, values in expected.items():
        # Folding rounds once more, in single precision.
        near = 1e-5 * max(1.0, float(np.median(np.abs(values))))
        rows = [row[meaning] for row in results]
        expect_near(rows, values, f"the list of layers gives another {meaning}", rtol=1e-5, atol=near)
    reference.reset()
    first = reference.results(x[0])["prediction"]
    expect(np.array_equal(first, results[0]["prediction"]), "a reset of the list of layers leaves something behind")


def check_graph_costs(predictor: Predictor) -> None:
    """Check that the layer graph has the multiply-accumulates of the network, and no larger state."""
    graph = predictor.graph()
    # A physics base has no weights: its arithmetic is element by element.
    costs = [cost for cost in predictor.costs() if not cost.part.startswith("physics base")]
    counted = sum(cost.per_column + cost.per_prediction + cost.pooling for cost in costs)
    expect(graph.macs == counted, f"the list has {graph.macs} multiply-accumulates a tick, the parts count {counted}")
    carried = sum(slot.size for _, slot in graph.slots())
    state = state_numbers(predictor.initial_state(1, torch.zeros(1)))
    # A tenth more and eight numbers: counters that exports need and networks do not.
    expect(carried <= 1.1 * state + 8, f"the list carries {carried} numbers, the network {state}")
    machine = 0 if predictor.physics is None else MACHINE_CONSTANTS
    trees = [part for part in predictor.modules() if isinstance(part, Trees)]
    tables = sum(table.numel() for part in trees for table in part.buffers())
    # Constants of scaling and geometry are no parameters, but take memory.
    most = parameters_of(predictor) * 1.1 + 200 + machine + tables
    expect(graph.parameters <= most, f"the list holds {graph.parameters} numbers; at most {most:.0f} must hold")


def check_network(predictor: Predictor) -> None:
    """Check all contracts of this module.

    Args:
        predictor: any network; it is left as it is.

    Raises:
        ContractError: one of them is broken; the message says which and how.
    """
    # Shapes and types are those of single precision; everything else is held in double.
    single = copy.deepcopy(predictor).float().eval()
    double = copy.deepcopy(single).double()
    for check in (check_shapes, check_determinism):
        check(single)
    others = (check_causality, check_chunks, check_reset, check_state_is_left, check_batch, check_gradients)
    counts = (check_parameters_counted, check_work_counted, check_operations)
    for check in (*others, *counts, check_graph, check_graph_costs):
        check(double)


def _layout(state: State) -> list[tuple[torch.Size, torch.dtype]]:
    """Return the shapes and types of a state's tensors, in their order."""
    layout = []

    def note(tensor: Tensor) -> Tensor:
        layout.append((tensor.shape, tensor.dtype))
        return tensor

    map_state(note, state)
    return layout


def _stream_outputs(predictor: Predictor) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return inputs ``(time, input)``, predictions and, if there are any, bounds, as streamed by PyTorch."""
    draw = torch.Generator().manual_seed(0)
    x = torch.randn(1, TICKS, predictor.front.inputs, generator=draw).double()
    with torch.no_grad():
        results = {"prediction": predictor.predict(x, predictor.initial_state(1, x))[0][0].flatten(1)}
        if predictor.output.coverages:
            bounds, _ = predictor.intervals(x, predictor.initial_state(1, x))
            results |= {"lower": bounds[0, :, :, 0].flatten(1), "upper": bounds[0, :, :, 1].flatten(1)}
    return x[0].numpy(), {meaning: values.numpy() for meaning, values in results.items()}
