"""Page of a monitor's run: alarms, evidence, and possible causes."""
