"""Shapes of the equations of elements, the same in fits, runs and exported layers."""

SLIP = 0.005
"""Fraction of the highest velocity over which friction changes sign. Smaller values make the fit stiff; larger values
let loads creep."""
EDGE = 0.01
"""Fraction of a tank's height over which the overflow starts. A sharp edge gives the fit additional local minima."""
SPILL = 0.8
"""Fraction of the volume above the edge that leaves in one sample. Explicit steps are stable for fractions below 2."""
EMPTY = 1e-30
"""Minimum level as a fraction of a tank's height, because the logarithm of zero is undefined."""
