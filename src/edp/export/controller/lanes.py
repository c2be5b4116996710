"""C code of a twin that runs a batch of copies: each layer is computed for all copies; weights are read once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from edp.errors import ExportError
from edp.export.c.calls import Calls, constant, describe, slot
from edp.export.c.model import Model, make_model, remembered
from edp.export.c.text import call, filled, identifier, indented, number
from edp.export.controller.parts import PlanParts
from edp.export.controller.plants import plant_files, plant_values
from edp.export.escape import Code
from edp.ir import Layer, layers, memory
from edp.ir.base import INPUT, Number
from edp.networks.input_range import input_limits
from edp.networks.twin import TwinPlant
from edp.training.bundle import Bundle

RUNTIME = ("edp_lanes.h", "edp_lanes.c")
PORTS, FED = "ports.", "ports.fed"
"""Layers of a plant that choose between measured values and last answers, and what they choose."""


@dataclass(frozen=True, eq=False)
class LaneModel:
    """Template values of a batched model.

    Attributes:
        name: C prefix.
        model: layers and the plan of their values.
        plant: the twin.
    """

    name: str
    model: Model
    plant: TwinPlant

    template = "plan_lanes"
    fragments = ("fields.h", "pressures.c")

    def sizes(self, plan: PlanParts) -> dict[str, int]:
        """Return additional sizes that the controller defines."""
        return {}

    def cost(self, plan: PlanParts) -> str:
        """Return the cost of one controller step, for the header."""
        macs = plan.lane_ticks * self.model.graph.macs
        return (
            f" * COST. A tick runs {plan.lane_ticks} ticks of the model, {macs} multiply-accumulates, and up to "
            f"{plan.iterations} iterations\n * of the solver, in double precision (see edp_qp.h). No other loop has a "
            "length that varies."
        )

    @property
    def work(self) -> int:
        """Number of scratch elements per copy."""
        return self.model.plan.sizes[Number.FLOAT]

    @property
    def memory_bytes(self) -> int:
        """State size per copy, without padding by the compiler."""
        rings = sum(line.startswith("edp_ring ") for line in remembered(self.model.graph)[0])
        slots = (max(1, part.size) for _, part in self.model.graph.slots() if part.name != "age")
        return 4 * sum(slots) + 8 * rings

    def files(self) -> dict[str, str]:
        """Model and runtime by file name."""
        return plant_files("plant", self.model, self._values(), RUNTIME)

    @property
    def sources(self) -> tuple[str, ...]:
        """C files that a program with this model compiles."""
        return (f"{self.name}.c", *(name for name in (*self.model.runtime, *RUNTIME) if name.endswith(".c")))

    def _values(self) -> dict[str, object]:
        graph, twin = self.model.graph, self.plant.twin
        fields, cleared = remembered(graph)
        low, high = input_limits(self.plant)
        at = self.model.plan.values[graph.results["prediction"]]
        return {
            **plant_values(self.model, self.plant),
            "inputs": graph.inputs,
            "work": self.work,
            "prefix": max(1, twin.prefix_ticks),
            # C has no struct without members: a map of the commands alone remembers nothing.
            "fields": indented(fields or ["float none[1];"]),
            "forget": indented(cleared or ["s->none[0] = 0.0f;"]),
            "low": filled(map(number, low)),
            "high": filled(map(number, high)),
            "compute": indented(self._write_statements(free=False)),
            "run": indented(self._write_statements(free=True)),
            "result": Code(f" + {at}" if at else ""),
        }

    def _write_statements(self, free: bool) -> Iterator[str]:
        """Yield the statements of a time step. Neighbouring layers without products share one loop over the copies.

        Args:
            free: whether no port is measured; ports then read the last outputs, and the layers between are omitted.
        """
        calls, together = Calls(self.model.graph, self.model.plan), list[str]()
        for layer in self.model.graph.layers:
            if free and layer.name.startswith(PORTS):
                together += self._write_port_layer(calls, layer)
                continue
            whole = self._whole(calls, layer)
            if whole is None:
                together += [describe(layer), *calls.translate(layer)]
                continue
            yield from _loop(self.name, together)
            yield from (describe(layer), whole)
            together = []
        yield from _loop(self.name, together)

    def _write_port_layer(self, calls: Calls, layer: Layer) -> list[str]:
        """Return the remaining statements of a port layer if all ports run free."""
        if layer.name != FED:
            return []
        last = next(x for x in self.model.graph.layers if isinstance(x, memory.Feedback))
        return [describe(layer), call("edp_copy", slot(last, "last"), last.size, calls.value(FED))]

    def _whole(self, calls: Calls, layer: Layer) -> str | None:
        """Return the call that computes a layer for all copies; None if the runtime has no such function."""
        if any(source == INPUT for source in layer.inputs):
            return None
        if isinstance(layer, layers.Dense) and layer.rows == 1:
            source, stride = _first(calls.value(layer.inputs[0])), self.work
            weights = (constant(layer, "weight"), constant(layer, "bias"))
            rest = (*layer.weight.shape, _first(calls.value(layer.name)), stride, "count")
            return call("edp_dense_lanes", source, stride, *weights, *rest)
        if isinstance(layer, memory.Gru):
            h = f"lanes[0].{slot(layer, 'h').removeprefix('s->')}"
            sizes = (layer.weight_x.shape[1], layer.width, h, "STRIDE")
            places = (_first(calls.scratch(layer)), _first(calls.value(layer.name)), self.work, "count")
            source = _first(calls.value(layer.inputs[0]))
            return call("edp_gru_lanes", source, f"&{identifier(layer.name)}_weights", *sizes, *places)
        return None


def _first(location: str) -> str:
    """Return a location in the work memory of the first copy."""
    return location.replace("work", "works[0]", 1)


def _loop(name: str, statements: list[str]) -> Iterator[str]:
    """Yield the statements of one copy inside a loop over all copies."""
    if not statements:
        return
    text = " ".join(statements)
    yield "for (uint32_t k = 0; k < count; k++) {"
    # Compilers warn of names that are not used.
    if "s->" in text:
        yield f"    {name}_memory *const s = &lanes[k];"
    if "(in," in text or "(in " in text:
        yield "    const float *const in = rows[k];"
    yield "    float *const work = works[k];"
    yield from (f"    {line}" for line in statements)
    yield "}"


def lane_model(name: str, bundle: Bundle) -> LaneModel:
    """Create a batched model of a twin, ready to be written.

    Args:
        name: C prefix of the model.
        bundle: bundle of a `TwinPlant`.

    Raises:
        ExportError: no twin, one in integer arithmetic, or one with a layer that solves equations by iterations.
    """
    plant = bundle.predictor
    if not isinstance(plant, TwinPlant):
        raise ExportError("the model of a controller is a twin; export a run of edp loop run whose twin is one")
    model = make_model(name, bundle)
    if model.integer or model.hydraulic:
        what = "computes in integer arithmetic" if model.integer else "has a network on a grey box"
        raise ExportError(
            f"the twin of the controller {what}, which no plan in C can follow; run edp loop run with a recurrent twin "
            "or a grey box"
        )
    return LaneModel(name, model, plant)
