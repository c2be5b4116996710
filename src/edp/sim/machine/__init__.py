"""Machines: their parameters, the files that hold them, and families drawn around one."""
