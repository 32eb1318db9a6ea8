"""The road map around one signal, out of a SUMO net."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt

from protocol.roadmap import Lane, RoadMap
from sim_host.links import junctions_of, read_signal
from sim_host.netfile import Net, NetJunction, Point

MAP_RADIUS_M = 320.0


def road_map(net: Net, tls: str | None) -> RoadMap:
    """Returns all lanes within 320 m of the signal, whole, and the signal itself.

    Raises:
        ConfigError: see `read_signal`.
    """
    signal = read_signal(net, tls)
    junctions = junctions_of(net, signal.tls)
    centre = _centre(junctions) if junctions else _stop_bar(net, signal.links[0].from_lane)
    near = _near(net, centre) | {
        lane for link in signal.links for lane in (link.from_lane, link.to_lane)
    }
    successors = _successors(net, near)
    return RoadMap(
        name=net.path.name.removesuffix(".gz").removesuffix(".net.xml"),
        centre=centre,
        lanes=[
            Lane(
                id=lane.id,
                edge=lane.edge,
                width_m=lane.width_m,
                speed_mps=lane.speed_mps,
                length_m=lane.length_m,
                centreline=lane.shape,
                successors=successors[lane.id],
                internal=lane.internal,
            )
            for lane in (net.lanes[name] for name in sorted(near))
        ],
        signal=signal,
        junction=_outline(junctions),
    )


def _centre(junctions: list[NetJunction]) -> Point:
    x, y, z = np.mean([junction.centre for junction in junctions], axis=0)
    return float(x), float(y), float(z)


def _stop_bar(net: Net, lane: str) -> Point:
    return net.lanes[lane].shape[-1]


def _near(net: Net, centre: Point) -> set[str]:
    at = np.array(centre[:2])
    return {
        lane.id
        for lane in net.lanes.values()
        if lane.drivable and len(lane.shape) > 1 and _distance(lane.shape, at) <= MAP_RADIUS_M
    }


def _distance(shape: list[Point], at: npt.NDArray[np.float64]) -> float:
    points = np.array(shape)[:, :2]
    start, step = points[:-1], np.diff(points, axis=0)
    squared = np.maximum((step**2).sum(axis=1), 1e-12)
    along = np.clip(((at - start) * step).sum(axis=1) / squared, 0.0, 1.0)
    return float(np.linalg.norm(start + along[:, None] * step - at, axis=1).min())


def _successors(net: Net, kept: set[str]) -> dict[str, list[str]]:
    """Maps lanes to the lanes they lead into, through the lanes inside junctions."""
    result: dict[str, list[str]] = {lane: [] for lane in kept}
    for connection in net.connections:
        into = connection.via or connection.to_lane
        if connection.from_lane in kept and into in kept:
            result[connection.from_lane].append(into)
    return {lane: list(dict.fromkeys(after)) for lane, after in result.items()}


def _outline(junctions: list[NetJunction]) -> list[tuple[float, float]]:
    if len(junctions) == 1:
        return [(x, y) for x, y, _ in junctions[0].shape]
    return _hull((x, y) for junction in junctions for x, y, _ in junction.shape)


def _hull(points: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Returns the convex hull, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(set(points))
    return _chain(ordered) + _chain(ordered[::-1])


def _chain(ordered: list[tuple[float, float]]) -> list[tuple[float, float]]:
    chain: list[tuple[float, float]] = []
    for x, y in ordered:
        while len(chain) > 1:
            (ax, ay), (bx, by) = chain[-2:]
            if (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0:
                break
            chain.pop()
        chain.append((x, y))
    return chain[:-1]
