"""CasADi: the step with explicit states as a symbolic function, and from C with its Jacobian."""

from edp.export.casadi.target import CasadiTarget

__all__ = ["CasadiTarget"]
