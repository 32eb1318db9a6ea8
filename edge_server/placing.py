"""Decode and place: the stages that turn a payload into points on the road, in the map frame.

Both need one chunk alone, so that threads run them while other chunks are still in transit. The
paper's merge by differences of Euler angles needs a reference sensor: it places a whole frame.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.frame import Chunk, ChunkStage, Frame, FrameStage, FrameState
from perception.arrays import Floats
from perception.config import GeofenceConfig
from perception.roadway import Roadway
from protocol.codec import decode
from protocol.geometry import SE3, euler_rotation


class Decode(ChunkStage):
    """Decompresses a chunk's points.

    Raises CodecError for a payload that is no scan. A chunk without payload holds its points.
    """

    name = "decode"

    def run(self, chunk: Chunk) -> Chunk:
        """See `ChunkStage.run`."""
        if chunk.payload is None:
            return chunk
        points = np.ascontiguousarray(decode(chunk.payload).points, np.float32)
        return replace(chunk, payload=None, points=points, returns=len(points))


class Place(ChunkStage):
    """Moves a chunk's points into the map by its exact pose and keeps those on the road."""

    name = "place"

    def __init__(self, roadway: Roadway, fence: GeofenceConfig) -> None:
        self._roadway = roadway
        self._fence = fence

    def run(self, chunk: Chunk) -> Chunk:
        """See `ChunkStage.run`."""
        return self.by(chunk, SE3.from_pose(chunk.sensor_pose))

    def by(self, chunk: Chunk, map_SE3_sensor: SE3) -> Chunk:
        """Returns the chunk placed by a sensor's pose.

        Its points in the sensor frame are freed: the next chunk is decoded into memory that is
        still in the cache.
        """
        fence = self._fence
        placed = self._roadway.place(
            chunk.points, map_SE3_sensor, below_m=fence.below_m, above_m=fence.above_m
        )
        return replace(chunk, points=np.zeros((0, 3), np.float32), placed=placed)


class PlaceByReference(FrameStage):
    """Places a frame's chunks by way of a reference sensor, as in the paper."""

    name = "place"

    def __init__(self, place: Place) -> None:
        self._place = place

    def run(self, state: FrameState) -> None:
        """See `FrameStage.run`."""
        reference_pose = _reference(state.frame)
        chunks = [
            self._place.by(chunk, by_angle_differences(chunk.sensor_pose, reference_pose))
            for chunk in state.frame.chunks
        ]
        state.frame = replace(state.frame, chunks=chunks)


def by_angle_differences(sensor_pose: Floats, reference_pose: Floats) -> SE3:
    """Returns `map_SE3_sensor` by way of a reference sensor, as Chen et al. 2022, eq. 1 and 2.

    The rotation between the two is built from the differences of their Euler angles, and the
    translation holds the difference of their mounting heights. Exact while both stand level; on a
    slope it is off by centimetres, which is why `se3` is the default.
    """
    map_SE3_reference = SE3.from_pose(reference_pose)
    roll, pitch, yaw = sensor_pose[3:] - reference_pose[3:]
    offset = map_SE3_reference.rotation.T @ (sensor_pose[:3] - reference_pose[:3])
    return map_SE3_reference @ SE3(euler_rotation(roll, pitch, yaw), offset)


def _reference(frame: Frame) -> Floats:
    """Returns the pose of the paper's reference LiDAR: a roadside one, else the first."""
    if not frame.chunks:
        return np.zeros(6)
    driving = {pose.agent for pose in frame.poses}
    roadside = [chunk for chunk in frame.chunks if chunk.agent not in driving]
    return (roadside or frame.chunks)[0].sensor_pose
