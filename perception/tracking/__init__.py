"""Tracking: vehicles keep their id, get a speed, and stay known while nobody sees them.

- `tracks`: the result, `Tracks`
"""
