"""Diagnosis of alarms: component and kind of fault, size, severity, and alternatives."""
