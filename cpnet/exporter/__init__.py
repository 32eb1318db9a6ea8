"""A run's figures in Prometheus' format, from what the supervisor hears on the world bus."""
