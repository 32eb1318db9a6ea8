"""LiDAR scans of a running CARLA server, while SUMO moves the traffic."""
