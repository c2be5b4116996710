"""Shapes of the equations of elements, the same in fits, runs and exported layers."""

SLIP = 0.005
"""Share of the fastest velocity over which friction turns round; less makes the fit stiff, more lets loads creep."""
EDGE = 0.01
"""Share of a tank's height over which its overflow sets in; a hard edge leaves the fit in valleys of its own."""
SPILL = 0.8
"""Share of what stands above the edge that leaves in a tick; explicit steps stay stable below 2 a step."""
EMPTY = 1e-30
"""Share of a tank's height below which it counts as this full: a logarithm has no zero."""
