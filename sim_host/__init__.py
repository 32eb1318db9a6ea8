"""The SUMO world, its scenarios, the signal cabinet, the clock and the truth."""
