"""The same small road and cars as the edge's tests."""

from tests.edge_server.conftest import climbing_road, ground, road_map, shell

__all__ = ["climbing_road", "ground", "road_map", "shell"]
