"""Mutual alignment: checks agents' poses against each other by scan registration.

Walls that several agents see are doubled where a pose is wrong. The upright points of a scan are
moved until most of them lie over those of the others: first by a search in the plane, then by
point-to-plane ICP (`small_gicp`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import small_gicp

from protocol.geometry import SE3, Floats, euler_rotation, wrap_angle
from recording.foreign_scans.agents import Agent
from recording.foreign_scans.alignment import cells, occupied, search
from recording.foreign_scans.ground import plane_below

_FAR_M = 50.0  # of a sensor: beyond, beams lie far apart
_VOXEL_M = 0.3
_REACH_M = 0.8  # that a point is drawn, after the search
_NEIGHBOURS = 12
_SAME_M, _KNOWN_M = 0.25, 2.0  # from the others: the same surface; where they see anything at all
_LEAST_KNOWN = 200  # voxels
_OFF_M, _OFF_DEG = 0.3, 0.5  # less is what poses are usually off
_GAIN, _GOOD = 0.1, 0.5  # of the share that fits: so much must a shift bring, so much must fit then
_ALIKE_M, _ALIKE_RAD = 0.4, np.radians(1.0)


@dataclass(frozen=True, slots=True, eq=False)
class Misplaced:
    """An agent whose poses contradict those of others.

    `offset` (4,) is their error: x, y, z in m, map frame, yaw in rad. `before` and `after` are the
    shares of its upright points near those of the others that lie over them.
    """

    agent: str
    offset: Floats
    before: float
    after: float

    def __str__(self) -> str:
        """The message for the user."""
        x_m, y_m, z_m, yaw_rad = (-self.offset).tolist()
        yaw_deg, before, after = np.degrees(yaw_rad), 100 * self.before, 100 * self.after
        return (
            f"agent {self.agent}: what it sees lies {np.hypot(x_m, y_m):.2f} m and "
            f"{abs(yaw_deg):.1f} degrees off what others see: {before:.0f} % of it fits, "
            f"{after:.0f} % if its poses are moved by x {x_m:+.2f}, y {y_m:+.2f}, z {z_m:+.2f} m "
            f"and yaw {yaw_deg:+.1f} deg"
        )


def misplaced(agents: Sequence[Agent]) -> list[Misplaced]:
    """Returns the agents whose scans contradict those of the others, in most frames.

    The majority decides which are wrong; of two, the one that sees more is taken to be right.
    """
    count = len(agents[0].files)
    frames = sorted({0, count // 2, count - 1})
    found: dict[str, list[Misplaced]] = {}
    for number in frames:
        for one in _in_frame({agent.name: _scan(agent, number) for agent in agents}):
            found.setdefault(one.agent, []).append(one)
    return [
        Misplaced(
            agent.name,
            np.median([one.offset for one in found[agent.name]], axis=0),
            float(np.mean([one.before for one in found[agent.name]])),
            float(np.mean([one.after for one in found[agent.name]])),
        )
        for agent in agents
        if 2 * len(found.get(agent.name, [])) > len(frames)
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """A sensor's position (3,), and the points around it (N, 3), along the map's axes."""

    sensor_m: Floats
    stands: Floats
    lies: Floats

    def moved(self, offset: Floats) -> _Seen:
        """Returns it as seen from where the sensor is without the offset (4,)."""
        turn = euler_rotation(0.0, 0.0, -offset[3])
        return _Seen(self.sensor_m - offset[:3], self.stands @ turn.T, self.lies @ turn.T)


def _scan(agent: Agent, number: int) -> _Seen:
    pose = SE3.from_pose(agent.pose(number))
    upright = agent.cloud(number).points.astype(np.float64) @ pose.rotation.T
    near = upright[np.hypot(upright[:, 0], upright[:, 1]) < _FAR_M]
    _, first = np.unique(np.floor(near / _VOXEL_M).astype(np.int64), axis=0, return_index=True)
    near, plane = near[np.sort(first)], plane_below(near)
    over_m = near[:, 2] - plane[0] - near[:, :2] @ plane[1:]
    return _Seen(
        pose.translation, near[(over_m > 0.3) & (over_m < 4.0)], near[np.abs(over_m) < 0.3]
    )


def _in_frame(scans: Mapping[str, _Seen]) -> list[Misplaced]:
    """Returns who is misplaced against those that see more; if all agree, the first of these."""
    names = sorted(scans, key=lambda name: (-len(scans[name].stands), name))
    placed, found, fits = [scans[names[0]]], list[Misplaced](), 0
    for name in names[1:]:
        one = _against(name, scans[name], placed)
        if one is None:
            continue
        fits += 1
        if _is_off(one):
            found.append(one)
            placed.append(scans[name].moved(one.offset))
        else:
            placed.append(scans[name])
    if len(found) == fits >= 2:
        first_m = scans[names[0]].sensor_m
        offsets = np.array([_blamed(one, scans[one.agent].sensor_m, first_m) for one in found])
        if not _are_alike(offsets):
            return found
        mean = [float(np.mean([getattr(one, key) for one in found])) for key in ("before", "after")]
        return [Misplaced(names[0], offsets.mean(axis=0), *mean)]
    return found


def _is_off(one: Misplaced) -> bool:
    off_m, off_deg = np.hypot(*one.offset[:2]), abs(np.degrees(one.offset[3]))
    better = one.after >= max(one.before + _GAIN, _GOOD)
    return bool(better and (off_m > _OFF_M or off_deg > _OFF_DEG))


def _blamed(one: Misplaced, sensor_m: Floats, other_m: Floats) -> Floats:
    """Returns the offset (4,) of another agent, at (3,), if it is that one that is off."""
    back = euler_rotation(0.0, 0.0, one.offset[3])
    place_m = back @ (other_m - sensor_m + one.offset[:3]) + sensor_m
    return np.array([*(other_m - place_m), -one.offset[3]])


def _are_alike(offsets: Floats) -> bool:
    spread = np.ptp(offsets, axis=0)
    return bool(spread[:3].max() < _ALIKE_M and spread[3] < _ALIKE_RAD)


def _against(name: str, seen: _Seen, others: Sequence[_Seen]) -> Misplaced | None:
    """Registers a scan against others; None where they overlap too little."""
    origin = others[0].sensor_m
    around = np.concatenate([one.stands + one.sensor_m - origin for one in others])
    if min(len(around), len(seen.stands)) < _LEAST_KNOWN:
        return None
    cloud = np.concatenate([around, *(one.lies + one.sensor_m - origin for one in others)])
    target = small_gicp.PointCloud(cloud)
    tree, walls = small_gicp.KdTree(target), small_gicp.KdTree(small_gicp.PointCloud(around))
    small_gicp.estimate_normals(target, tree, _NEIGHBOURS)
    here_m = seen.sensor_m - origin
    before, known = _fits(walls, seen.stands + here_m)
    if known < _LEAST_KNOWN:
        return None
    guess = np.array([*here_m[:2], 0.0])
    x_m, y_m, yaw_rad = search(cells(seen.stands[:, :2]), occupied(cells(around[:, :2])), guess)
    start = SE3.from_pose([x_m, y_m, here_m[2], 0.0, 0.0, yaw_rad])
    result = small_gicp.align(
        target,
        small_gicp.PointCloud(np.concatenate([seen.stands, seen.lies])),
        tree,
        np.block([[start.rotation, start.translation[:, None]], [np.zeros(3), 1.0]]),
        registration_type="PLANE_ICP",
        max_correspondence_distance=_REACH_M,
        num_threads=1,
    )
    motion = np.array(result.T_target_source)
    after, _ = _fits(walls, seen.stands @ motion[:3, :3].T + motion[:3, 3])
    turn = float(wrap_angle(np.arctan2(motion[1, 0], motion[0, 0])))
    return Misplaced(name, np.array([*(here_m - motion[:3, 3]), -turn]), before, after)


def _fits(tree: small_gicp.KdTree, points: Floats) -> tuple[float, int]:
    """Returns the share of points (N, 3), near those of others, that fit them; their number."""
    _, squares = map(np.asarray, tree.batch_nearest_neighbor_search(points))
    known = int((squares < _KNOWN_M**2).sum())
    return float((squares < _SAME_M**2).sum()) / max(known, 1), known
