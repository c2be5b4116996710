"""Flow balances as C: spool positions from commands, opening curves, and one residual per chamber."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edp.export.c.model import Model
from edp.export.c.text import number
from edp.export.monitor.numbers import MonitorTables
from edp.export.monitor.parts import FlowChamber, FlowPart

NO_PLACE = 0xFFFF
"""A command that is not there."""
FLOW = """
static float {own}_root(float drop) {{
    const float positive = (drop > 0.0f) ? drop : 0.0f;
    float inner = (positive * positive) + {smooth};
    edp_map_sqrt(&inner, 1u, &inner);
    edp_map_sqrt(&inner, 1u, &inner);
    return positive / inner;
}}

/* A curve of an opening at a travel, times what drives it. */
static float {own}_path(uint32_t path, float travel, float drive) {{
    const float *const values = &{own}_values[path * {knots}u];
    const float *const slopes = &{own}_slopes[path * {knots}u];
    const float inside = (travel > {own}_knots[0]) ? travel : {own}_knots[0];
    uint32_t at = 0u;
    while (((at + 1u) < {knots}u) && ({own}_knots[at + 1u] <= inside)) {{
        at++;
    }}
    return (values[at] + ((inside - {own}_knots[at]) * slopes[at])) * drive;
}}

static float {own}_demand(const float *row, uint32_t spool) {{
    const float back = ({own}_retract[spool] == {none}u) ? 0.0f : row[{own}_retract[spool]];
    return (row[{own}_extend[spool]] - back) * {own}_gain[spool];
}}

static float {own}_stage(const float *numbers, float *state, float in) {{
    const float out = state[0];
    state[0] = (state[1] + (in * numbers[0])) - (out * numbers[2]);
    state[1] = (in * numbers[1]) - (out * numbers[3]);
    return out;
}}

/* Where a spool was some ticks ago: dead time, a stage, play, a stage. */
static float {own}_spool({name}_state *s, uint32_t spool) {{
    const uint32_t late = (s->{own}_at + {length}u - {own}_late[spool]) % {length}u;
    const float near = {own}_demand(s->{own}_past[late], spool);
    const float far = {own}_demand(s->{own}_past[(late + {length}u - 1u) % {length}u], spool);
    const float *const stages = &{own}_stages[spool * 8u];
    const float moved = {own}_stage(stages, s->{own}_first[spool], near + ({own}_part[spool] * (far - near)));
    const float low = moved - {own}_play[spool];
    const float high = moved + {own}_play[spool];
    const float limited = (s->{own}_played[spool] < high) ? s->{own}_played[spool] : high;
    s->{own}_played[spool] = (limited > low) ? limited : low;
    return {own}_stage(&stages[4], s->{own}_second[spool], s->{own}_played[spool]);
}}

/* As if the first row had been there for long. */
static void {own}_begin({name}_state *s) {{
    for (uint32_t i = 0; i < {length}u; i++) {{
        edp_copy(s->{own}_in, {reads}u, s->{own}_past[i]);
    }}
    for (uint32_t spool = 0; spool < {spools}u; spool++) {{
        const float demand = {own}_demand(s->{own}_in, spool);
        const float *const stages = &{own}_stages[spool * 8u];
        s->{own}_first[spool][0] = demand;
        s->{own}_first[spool][1] = demand * (stages[1] - stages[3]);
        s->{own}_second[spool][0] = demand;
        s->{own}_second[spool][1] = demand * (stages[5] - stages[7]);
        s->{own}_played[spool] = demand;
    }}
    s->{own}_began = true;
}}

/* Distance to an end of the stroke in lengths of the cushion, 1 at most. */
static float {own}_near(const {own}_chamber *c, float stroke, float end) {{
    const float apart = stroke - end;
    const float lengths = ((apart < 0.0f) ? -apart : apart) * c->per_cushion;
    return ((c->stroke == {none}u) || (lengths > 1.0f)) ? 1.0f : lengths;
}}

static void {own}_add(float part, float *flow, float *through) {{
    *flow += part;
    *through += (part < 0.0f) ? -part : part;
}}

/* The velocity of a piston less what flows make of it, over how far that usually is off; all {back} ticks ago. */
static float {own}_balance(const {name}_state *s, const {own}_chamber *c, const float *spools) {{
    const float *const then = s->{own}_past[(s->{own}_at + {length}u - {back}u) % {length}u];
    const float sign = c->grows ? 1.0f : -1.0f;
    const float own = then[c->own] * 1e-6f;
    const float other = then[c->other] * 1e-6f;
    const float first = spools[c->first] * sign;
    const float in = (first > 0.0f) ? first : 0.0f;
    const float out = (-first > 0.0f) ? -first : 0.0f;
    const float away = {own}_root(own - c->tank);
    const float stroke = (c->stroke == {none}u) ? 0.0f : then[c->stroke];
    const float near = {own}_near(c, stroke, c->end);
    const float shut = 1.0f - ((near * near) * ((3.0f - near) - near));
    const float at_end = 1.0f - near;
    const float at_other = 1.0f - {own}_near(c, stroke, c->far);
    float flow = 0.0f;
    float through = 0.0f;
    float width;
    float step[4];
    float rate;
    float soft;
    uint32_t path = c->paths;
    for (uint32_t k = 0; k < c->count; k++) {{
        const float drive = {own}_root((then[{own}_pumps[c->pumps + k]] * 1e-6f) - own);
        {own}_add({own}_path(path++, in, drive), &flow, &through);
    }}
    {own}_add({own}_path(path++, in, {own}_root(other - own)), &flow, &through);
    {own}_add({own}_path(path++, out, away), &flow, &through);
    {own}_add({own}_path(path++, out, {own}_root(own - other)), &flow, &through);
    {own}_add({own}_path(path++, out, away * shut), &flow, &through);
    if (c->second != {none}u) {{
        const float travel = spools[c->second] * sign;
        const float more = (travel > 0.0f) ? travel : 0.0f;
        for (uint32_t k = 0; k < c->count; k++) {{
            const float drive = {own}_root((then[{own}_pumps[c->pumps + k]] * 1e-6f) - own);
            {own}_add({own}_path(path++, more, drive), &flow, &through);
        }}
    }}
    step[0] = s->{own}_past[s->{own}_at][c->own];
    step[1] = s->{own}_past[(s->{own}_at + {length}u - 1u) % {length}u][c->own];
    step[2] = s->{own}_past[(s->{own}_at + {length}u - 3u) % {length}u][c->own];
    step[3] = s->{own}_past[(s->{own}_at + {length}u - 4u) % {length}u][c->own];
    rate = (((step[0] - step[3]) + (step[1] - step[2])) * {per_tick}) * 1e-6f;
    soft = 1.0f / (((own > 0.0f) ? own : 0.0f) + {cavity});
    flow += c->lines[0];
    flow += c->lines[1] * rate;
    flow += c->lines[2] * (rate * stroke);
    flow += c->lines[3] * (rate * soft);
    flow += c->lines[4] * ((rate * soft) * soft);
    flow += c->lines[5] * {own}_root(c->tank - own);
    flow += c->lines[6] * (own - other);
    flow += c->lines[7] * own;
    flow += c->lines[8] * ((rate * stroke) * soft);
    for (uint32_t i = 0; i < {reliefs}u; i++) {{
        const float over = own - {own}_reliefs[i];
        flow += c->lines[9u + i] * ((over > 0.0f) ? over : 0.0f);
    }}
    {{
        const float over = own - {own}_reliefs[{doubtful}];
        const float hollow = {empty} - own;
        const float fast = (rate < 0.0f) ? -rate : rate;
        width = c->doubts[0];
        width += c->doubts[1] * fast;
        width += c->doubts[2] * (fast * soft);
        width += c->doubts[3] * ((hollow > 0.0f) ? hollow : 0.0f);
        width += c->doubts[4] * at_end;
        width += c->doubts[5] * at_other;
        width += c->doubts[6] * ((over > 0.0f) ? over : 0.0f);
        width += c->doubts[7] * through;
    }}
    return (then[c->velocity] - (sign * flow)) / width;
}}

static void {own}_residuals({name}_state *s) {{
    float spools[{spools}];
{hold}    if (!s->{own}_began) {{
        {own}_begin(s);
    }}
    s->{own}_at = (s->{own}_at + 1u) % {length}u;
    edp_copy(s->{own}_in, {reads}u, s->{own}_past[s->{own}_at]);
    for (uint32_t spool = 0; spool < {spools}u; spool++) {{
        spools[spool] = {own}_spool(s, spool);
    }}
    for (uint32_t i = 0; i < {residuals}u; i++) {{
        s->residuals[{first}u + i] = {own}_balance(s, &{own}_chambers[i], spools);
    }}
{oil}}}
"""
OIL = """\
    if ((s->{own}_in[{place}] < {low}) || (s->{own}_in[{place}] > {high})) {{
        /* Oil that was not learned: nothing is known of these flows. */
        edp_fill((float)edp_unknown(), {residuals}u, &s->residuals[{first}u]);
    }}
"""
CHAMBER = """\
typedef struct {{
    uint32_t velocity, own, other, stroke, first, second, paths, pumps, count;
    bool grows;
    float end, far, per_cushion, tank;
    const float *lines;
    const float *doubts;
}} {own}_chamber;"""


class FlowCode:
    """Balances of flow; see `FlowPart`.

    Args:
        part: what it is.
        own: prefix of its names within the monitor.
        hold: C that keeps the last value of what is missing.
    """

    def __init__(self, part: FlowPart, own: str, hold: str) -> None:
        self.part, self.own, self.hold = part, own, hold
        self.model: Model | None = None
        self.residuals = len(part.chambers)

    @property
    def length(self) -> int:
        """Number of stored rows, including the present one."""
        return self.part.memory + 1

    def fields(self) -> list[str]:
        """See `SourceCode`."""
        own, spools, reads = self.own, len(self.part.gain), len(self.part.reads)
        memory = [f"float {own}_in[{reads}];", f"float {own}_past[{self.length}][{reads}];", f"uint32_t {own}_at;"]
        stages = [f"float {own}_{stage}[{spools}][2];" for stage in ("first", "second")]
        return [*memory, *stages, f"float {own}_played[{spools}];", f"bool {own}_began;"]

    def constants(self, tables: MonitorTables) -> None:
        """See `SourceCode`."""
        part, own = self.part, self.own
        tables.places(f"{own}_reads", part.reads)
        for name in ("extend", "retract"):
            tables.places(f"{own}_{name}", [_place(column) for column in getattr(part, name)])
        whole = np.floor(part.dead).astype(int)
        tables.places(f"{own}_late", (whole + part.back).tolist())
        tables.floats(f"{own}_part", part.dead - whole)
        for name in ("middle", "gain", "stages", "play", "knots", "reliefs"):
            tables.floats(f"{own}_{name}", getattr(part, name))
        for name in ("values", "slopes", "lines", "doubts"):
            tables.floats(f"{own}_{name}", np.concatenate([getattr(chamber, name) for chamber in part.chambers]))
        tables.places(f"{own}_pumps", [pump for chamber in part.chambers for pump in chamber.supplies])
        tables.text(CHAMBER.format(own=own))
        tables.text(self._chambers(part.chambers))

    def _chambers(self, chambers: Sequence[FlowChamber]) -> str:
        rows, paths, pumps = [], 0, 0
        for index, chamber in enumerate(chambers):
            second = chamber.spools[1] if len(chamber.spools) > 1 else NO_PLACE
            columns = [chamber.velocity, chamber.own, chamber.other, _place(chamber.stroke)]
            columns += [chamber.spools[0], second, paths, pumps, len(chamber.supplies)]
            numbers = [number(value) for value in (chamber.end, chamber.far, chamber.per_cushion, chamber.tank)]
            grows = "true" if chamber.sign > 0 else "false"
            lines = f"&{self.own}_lines[{index * len(chamber.lines)}]"
            doubts = f"&{self.own}_doubts[{index * len(chamber.doubts)}]"
            rows.append(f"    {{{', '.join([*(f'{c}u' for c in columns), grows, *numbers, lines, doubts])}}}")
            paths, pumps = paths + len(chamber.values), pumps + len(chamber.supplies)
        body = ",\n".join(rows)
        return f"static const {self.own}_chamber {self.own}_chambers[{len(rows)}] = {{\n{body}\n}};"

    def code(self, name: str, first: int) -> str:
        """See `SourceCode`."""
        part, oil = self.part, ""
        if part.oil is not None:
            low, high = (number(np.float32(end)) for end in part.oil[1:])
            oil = OIL.format(own=self.own, place=part.oil[0], low=low, high=high, residuals=self.residuals, first=first)
        return FLOW.format(
            oil=oil,
            own=self.own,
            name=name,
            hold=self.hold,
            first=first,
            residuals=self.residuals,
            length=self.length,
            reads=len(part.reads),
            spools=len(part.gain),
            knots=len(part.knots),
            reliefs=len(part.reliefs),
            back=part.back,
            none=NO_PLACE,
            smooth=number(part.smooth),
            cavity=number(part.cavity),
            empty=number(part.empty),
            doubtful=part.doubtful,
            per_tick=number(part.per_tick),
        )

    def reset(self) -> list[str]:
        """See `SourceCode`."""
        return [f"edp_copy({self.own}_middle, {len(self.part.reads)}u, s->{self.own}_in);"]

    def forget(self) -> list[str]:
        """See `SourceCode`."""
        return [f"s->{self.own}_began = false;"]


def _place(column: int) -> int:
    return column if column >= 0 else NO_PLACE
