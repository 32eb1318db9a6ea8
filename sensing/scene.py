"""The static world that sensors see: ground, kerbs, buildings, poles and trees."""

from __future__ import annotations

from dataclasses import dataclass

from protocol.messages import Setup
from protocol.roadmap import RoadMap
from sensing.buildings import buildings, from_polygons
from sensing.config import SceneConfig
from sensing.ground import ground
from sensing.kerbs import kerbs
from sensing.mesh import TriangleMesh, merge
from sensing.noise import stream
from sensing.road import RoadArea
from sensing.roadside import signal_posts, street_lights, trees
from sensing.terrain import Terrain


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """The parts of the static world, in the map frame, and the terrain that they stand on."""

    terrain: Terrain
    ground: TriangleMesh
    kerbs: TriangleMesh
    buildings: TriangleMesh
    poles: TriangleMesh
    trees: TriangleMesh

    @property
    def mesh(self) -> TriangleMesh:
        """All parts as one mesh."""
        return merge([self.ground, self.kerbs, self.buildings, self.poles, self.trees])


Outlines = list[list[tuple[float, float]]]


def build_scene(
    road_map: RoadMap,
    config: SceneConfig,
    seed: int,
    polygons: tuple[Outlines, list[float]] | None = None,
) -> Scene:
    """Builds the world around the road; nothing but ground lies on a lane or in the junction.

    Args:
        road_map: the lanes, in the map frame.
        config: what to build.
        seed: the scenario's; the same seed gives the same scene in every process.
        polygons: outlines and heights of the user's buildings, which replace those by seed.
    """
    terrain, road = Terrain(road_map, config, seed), RoadArea(road_map)
    edges = road.edges()
    if polygons is None:
        houses = buildings(edges, terrain, road, config, stream(seed, "buildings"))
    else:
        houses = from_polygons(*polygons, terrain, road_map)
    return Scene(
        terrain,
        ground(terrain, road),
        kerbs(edges, terrain, road, config),
        merge(houses),
        merge(
            [
                street_lights(edges, terrain, road, config),
                signal_posts(road_map, terrain, road),
            ]
        ),
        trees(edges, terrain, road, config, stream(seed, "trees")),
    )


def scene_of(setup: Setup, config: SceneConfig, seed: int) -> Scene:
    """Builds the scene that a run's set-up describes."""
    polygons = None
    if config.polygons is not None:
        polygons = (setup.polygons, setup.polygon_heights_m)
    return build_scene(setup.road_map, config, seed, polygons)
