"""A running system in a terminal."""
