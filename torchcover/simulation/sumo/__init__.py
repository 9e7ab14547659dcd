"""Traffic and road networks of SUMO."""
