"""A run that is hurt again and again, and whether it is right again in time: `scripts/soak`."""
