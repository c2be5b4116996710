"""Template values of the C file of the external function: reading and writing the state column."""

from __future__ import annotations

from itertools import groupby

from edp.export.c.model import has_ring
from edp.export.c.text import call, identifier, indented, number
from edp.export.casadi.states import Place, counts, is_ring, places, start
from edp.export.escape import Code
from edp.ir import Graph, Layer
from edp.ir.memory import UNSEEN


def blanks(graph: Graph, name: str) -> dict[str, object]:
    """Return the values of the blanks of the template."""
    load: list[str] = []
    store: list[str] = []
    load_change: list[str] = []
    store_change: list[str] = []
    for layer, group in groupby(places(graph), key=lambda state: state.layer):
        layer_states = list(group)
        load += _load_count(graph, graph.layer(layer), layer_states)
        for state in layer_states:
            if state.slot.name == "age":
                # CasADi's numbers are doubles; a count up to 2^31 is exact in them.
                store.append(f"x[{state.at}] = (double)s->{identifier(layer)}_ring_at.seen;")
                store_change.append(f"x[{state.at}] = 0.0;")
                continue
            for lines, who, fill in ((load, "s", None), (load_change, "t", None)):
                # The ring of the C code begins anywhere; CasADi's column has the oldest tick first.
                lines.append(_move_state(graph, state, "load", who, fill))
            store.append(
                _move_state(graph, state, "store", "s", number(UNSEEN if state.slot.name == "scores" else 0.0))
            )
            store_change.append(_move_state(graph, state, "store", "t", "0.0f"))
    every = ["x_next", *graph.results]
    sizes = [len(start(graph)), *map(graph.width_of, graph.results.values())]
    members = [f"&out->{result}{'[0][0]' if result == 'prediction' else '[0][0][0]'}" for result in graph.results]
    return {
        "name": name,
        "NAME": name.upper(),
        "states": sizes[0],
        "outputs": len(every),
        "names": Code(", ".join(f'"{result}"' for result in every)),
        "names_out_in": Code(", ".join(f'"out_{result}"' for result in every)),
        "names_jacobian": Code(", ".join(f'"jac_{result}_{by}"' for result in every for by in "xu")),
        "shapes": Code(", ".join(f"{{{size}, 1, 1}}" for size in sizes)),
        "jacobians": Code(", ".join(f"{{{size}, {by}, 1}}" for size in sizes for by in (sizes[0], graph.inputs))),
        "members": Code(", ".join(members)),
        "prediction": every.index("prediction"),
        "predictions": sizes[every.index("prediction")],
        "load": indented(load),
        "store": indented(store),
        "load_change": indented(load_change),
        "store_change": indented(store_change),
    }


def _load_count(graph: Graph, layer: Layer, layer_states: list[Place]) -> list[str]:
    """Return statements that set the ring or counter of a layer in the C state."""
    if not has_ring(layer):
        return []
    rings = [state for state in layer_states if is_ring(graph, state)]
    rows, where = max((state.rows for state in rings), default=0), f"s->{identifier(layer.name)}_ring_at"
    ages = [state for state in layer_states if state.slot.name == "age"]
    scores = [state for state in rings if state.slot.name == "scores"]
    lines = []
    if ages:
        most = rows if rings else getattr(layer, "ticks", 1)  # a difference and a mean of one count to one
        lines.append(f"{where}.seen = whole(x[{ages[0].at}], {most}u);")
    elif scores:
        lines.append(f"{where}.seen = scored(x + {scores[0].at}, {rows}u);")
    if rings and counts(graph, rings[0]):
        # A full ring begins at zero again; where it begins is free as long as the order is kept.
        lines.append(f"{where}.at = {where}.seen % {rows}u;")
    return lines


def _move_state(graph: Graph, state: Place, way: str, who: str, fill: str | None) -> str:
    field, column = f"{who}->{state.field}", f"x + {state.at}"
    if not is_ring(graph, state):
        return call(f"{way}_numbers", column, state.slot.size, field)
    ring = f"s->{identifier(state.layer)}_ring_at"
    seen = f"{ring}.seen" if counts(graph, state) else f"{state.rows}u"
    rest = [fill] if fill is not None else []
    return call(f"{way}_ring", column, state.rows, state.columns, f"{ring}.at", seen, *rest, field)
