"""CARLA as a sensor of cpnet, see docs/carla.md."""
