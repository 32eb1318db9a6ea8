"""Simulated sensors: the scene, LiDAR scans of it, and how well an agent knows its pose."""
