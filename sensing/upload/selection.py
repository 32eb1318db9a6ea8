"""Which beams of a scan go into which chunk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numba import njit

from perception.roadway import Roadway
from perception.thin import thin
from protocol.geometry import SE3
from protocol.messages import Plan
from protocol.scans import RangeScan, ScanPattern
from sensing.upload.cells import NOT_SENT, Bytes, Floats32, cut
from sensing.upload.chooser import Chooser
from sensing.upload.foreground import Background, driving_foreground
from sensing.upload.locate import locate
from sensing.upload.registry import Filter, Policy

Bools = npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """The chunk of each beam (channels, columns), or `NOT_SENT`; every beam has one at most.

    `plan_frame` is the frame of the plan that the chunks were cut by, -1 for none.
    """

    chunk: Bytes
    chunks: int
    plan_frame: int = -1

    def mask(self, chunk: int) -> Bools:
        """Returns which beams (channels, columns) belong to a chunk."""
        return np.asarray(self.chunk == chunk)

    def part(self, scan: RangeScan, chunk: int) -> RangeScan:
        """Returns the scan with no returns but a chunk's."""
        if self.chunks == 1 and not self.chunk.any():
            return scan  # all of it
        range_m, intensity = np.empty_like(scan.range_m), np.empty_like(scan.intensity)
        planes = (scan.range_m, scan.intensity, self.chunk, range_m, intensity)
        _take(*(plane.reshape(-1) for plane in planes), chunk)
        return RangeScan(scan.pattern, range_m, intensity)


class Selector:
    """Chooses for one agent. A standing sensor's selector learns from scan to scan."""

    def __init__(
        self,
        policy: Policy,
        filters: frozenset[Filter],
        roadway: Roadway,
        pattern: ScanPattern,
        chooser: Chooser | None = None,
        *,
        thin_m: float,
        standing: bool,
    ) -> None:
        self._policy = policy
        self._roadway = roadway
        self._roi = "roi" in filters
        self._foreground = "foreground" in filters
        self._chooser = chooser
        self._spacing_m = thin_m
        beams = pattern.channels * pattern.columns
        self._background = Background(beams) if standing and self._foreground else None

    @property
    def is_ground_free(self) -> bool:
        """Whether what is left has no ground."""
        return self._foreground

    def select(
        self, scan: RangeScan, map_SE3_sensor: SE3, agent: str, plan: Plan | None
    ) -> Selection:
        """Returns the chunks of a scan from a sensor that believes to be there.

        Without a plan that knows the agent, all that the filters leave goes into one chunk.
        """
        shape = scan.range_m.shape
        follows = self._policy.cells and plan is not None and agent in plan.agents
        if not (self._roi or self._foreground or follows or self._chooser):
            return Selection(np.zeros(shape, np.uint8), 1)
        range_m = np.ascontiguousarray(scan.range_m)
        located = locate(scan, map_SE3_sensor, self._roadway)
        keep = np.ones(range_m.size, np.uint8)
        if self._background is not None:
            keep = self._background.foreground(range_m.reshape(-1), located)
        elif self._foreground:
            keep = driving_foreground(located)
        if self._foreground:
            thin(range_m, self._spacing_m, keep.reshape(shape))
        chunk = np.empty(range_m.size, np.uint8)
        _begin(range_m.reshape(-1), located.above_m, keep, self._roi, chunk)
        if self._chooser is not None:
            chosen = self._chooser.choose(scan, map_SE3_sensor)
            left = np.where(chunk.reshape(shape) == NOT_SENT, chunk.reshape(shape), chosen)
            return Selection(left, self._policy.chunks)
        if not follows or plan is None:
            return Selection(chunk.reshape(shape), 1)
        cut(located.xy, chunk, plan.sites, plan.weights_m2, plan.agents.index(agent))
        if self._policy.chunks == 1:
            _only_plain(chunk)
        return Selection(chunk.reshape(shape), self._policy.chunks, plan.frame)


@njit("void(float32[::1], float32[::1], uint8[::1], boolean, uint8[::1])", cache=True)
def _begin(range_m: Floats32, above_m: Floats32, keep: Bytes, on_road: bool, chunk: Bytes) -> None:
    """Puts every return that the filters leave into the first chunk."""
    for beam in range(chunk.size):
        sent = range_m[beam] > 0 and keep[beam] and not (on_road and np.isnan(above_m[beam]))
        chunk[beam] = 0 if sent else NOT_SENT


@njit("void(uint8[::1])", cache=True)
def _only_plain(chunk: Bytes) -> None:
    """Makes one chunk of what lies within the plain borders, and leaves out the rest."""
    for beam in range(chunk.size):
        chunk[beam] = 0 if chunk[beam] <= 1 else NOT_SENT


@njit("void(float32[::1], float32[::1], uint8[::1], float32[::1], float32[::1], int64)", cache=True)
def _take(
    range_m: Floats32,
    intensity: Floats32,
    chunk: Bytes,
    range_out: Floats32,
    intensity_out: Floats32,
    wanted: int,
) -> None:
    for beam in range(chunk.size):
        taken = chunk[beam] == wanted
        range_out[beam] = range_m[beam] if taken else np.float32(0)
        intensity_out[beam] = intensity[beam] if taken else np.float32(0)
