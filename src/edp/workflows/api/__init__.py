"""The front door: what ``import edp`` offers. `edp` imports each name of these modules when it is first asked for."""
