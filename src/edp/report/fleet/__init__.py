"""A fleet as a page: machines by error, drift and alarms, and why the worst are so."""
