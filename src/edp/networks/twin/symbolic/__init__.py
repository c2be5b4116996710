"""Symbolic expressions: written with Python operators, differentiated automatically, compiled to machine code."""
