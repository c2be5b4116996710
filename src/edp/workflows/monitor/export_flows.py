"""Balances of flow on their way into exported C."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

import numpy as np

from edp.export.monitor import FlowChamber, FlowPart
from edp.monitor.residuals.flow_balances import FlowBalances
from edp.monitor.residuals.flow_curves import BACK, CAVITY, EMPTY, KNOTS, RELIEFS, SMOOTH


def flow_part(source: FlowBalances, columns: Mapping[str, int]) -> FlowPart:
    """Return flow balances as numbers; `columns` holds the position of each input in the monitor."""
    spools, chambers = source.spools, []
    for chamber in source.chambers:
        spots = asdict(chamber.spots)
        per_cushion = float(np.float32(1.0 / spots.pop("cushion")))
        chambers.append(
            FlowChamber(
                **spots,
                per_cushion=per_cushion,
                values=chamber.values,
                slopes=chamber.slopes,
                lines=chamber.lines,
                doubts=chamber.doubts,
            )
        )
    return FlowPart(
        reads=tuple(columns[name] for name in source.inputs),
        middle=source.middle,
        extend=tuple(spools.extend.tolist()),
        retract=tuple(spools.retract.tolist()),
        gain=spools.gain,
        dead=spools.dead,
        stages=spools.stages,
        play=spools.play,
        memory=spools.memory,
        back=BACK,
        knots=KNOTS,
        reliefs=RELIEFS,
        smooth=float(SMOOTH),
        cavity=float(CAVITY),
        empty=float(EMPTY),
        doubtful=1,
        per_tick=float(source.per_tick),
        chambers=tuple(chambers),
        oil=None if source.oil is None else (source.oil.column, source.oil.low, source.oil.high),
    )
