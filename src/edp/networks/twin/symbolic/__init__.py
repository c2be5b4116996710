"""Equations as expressions: written once with operators, differentiated automatically, compiled to machine code."""
