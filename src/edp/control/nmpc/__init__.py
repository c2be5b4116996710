"""Nonlinear model predictive control on a twin: its parts; the controller is `edp.control.controllers.nmpc`."""
