"""Selection of beams: which beams of a scan an agent sends, in which chunk.

By a plan, an agent owns the cell of a power diagram. All agents of a plan compare the same numbers
in the same way, so that every place has exactly one owner at the plain borders, however the numbers
are rounded; see `protocol.messages.Plan`. A plug-in chooses beam by beam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numba import njit

from perception.arrays import Bools, Bytes, Floats, Floats32
from perception.roadway import Roadway
from perception.thin import thin
from protocol.geometry import SE3
from protocol.messages import Plan
from protocol.plugins import Plugin
from protocol.scans import RangeScan, ScanPattern
from sensing.config import UploadConfig
from sensing.upload_filters import Background, driving_foreground, locate
from sensing.upload_policies import NAMES, Filter, Policy, policy_of

TIGHT, PLAIN, WIDE, BEYOND = 0, 1, 2, 3
NOT_SENT = 255


def cut(xy: Floats32, chunk: Bytes, sites: Floats, weights_m2: Floats, own: int) -> None:
    """Sets chunks (B,) to the tightest border that each place (B, 2) lies within, else `BEYOND`.

    Beams that are `NOT_SENT` stay so. `own` is the agent's index into sites (N, 2) and weights
    (N, 3: tight, plain, wide). Ties go to the agent with the lower index.
    """
    _cut(
        xy,
        chunk,
        np.ascontiguousarray(sites, np.float64),
        np.ascontiguousarray(weights_m2, np.float64),
        own,
    )


@njit("boolean(float64, float64, boolean)", cache=True)
def _owns(own: float, other: float, comes_first: bool) -> bool:
    return bool(own < other or (own == other and comes_first))


@njit(
    "void(float32[:,::1], uint8[::1], Array(float64, 2, 'C', readonly=True), "
    "Array(float64, 2, 'C', readonly=True), int64)",
    cache=True,
)
def _cut(xy: Floats32, chunk: Bytes, sites: Floats, weights_m2: Floats, own: int) -> None:
    own_tight, own_plain, own_wide = weights_m2[own]
    for beam in range(chunk.size):
        if chunk[beam] == NOT_SENT:
            continue
        x, y = np.float64(xy[beam, 0]), np.float64(xy[beam, 1])
        dx, dy = x - sites[own, 0], y - sites[own, 1]
        near = dx * dx + dy * dy
        border = TIGHT
        for other in range(sites.shape[0]):
            if other == own:
                continue
            dx, dy = x - sites[other, 0], y - sites[other, 1]
            far = dx * dx + dy * dy
            # Exactly one of two agents owns a place: what one claims at its tight border, the other
            # gives up at its wide one.
            if _owns(near - own_tight, far - weights_m2[other, 2], own < other):
                continue
            border = max(border, PLAIN)
            if _owns(near - own_plain, far - weights_m2[other, 1], own < other):
                continue
            border = max(border, WIDE)
            if not _owns(near - own_wide, far - weights_m2[other, 0], own < other):
                border = BEYOND
                break
        chunk[beam] = border


class Chooser(Protocol):
    """Chooses beams for one agent, scan by scan; it may learn from one scan to the next."""

    def choose(self, scan: RangeScan, map_SE3_sensor: SE3) -> Bytes:
        """Returns the chunk (channels, columns) of each beam, 255 for those that are not sent.

        Chunks leave in the order of their numbers, from 0 to one less than the policy's `chunks`;
        what a slow uplink has not taken when the next frame begins stays behind.

        Args:
            scan: range in m and intensity by ring and column; a range of 0 is no return. It must
                not be changed.
            map_SE3_sensor: estimated pose of the sensor, map frame, m.
        """


ChooserMaker = Callable[[UploadConfig, Roadway, ScanPattern], Chooser]
"""Makes the chooser of one agent; the settings of a plug-in are `plugin` of the configuration.

The roadway is the map's road with `upload.roi_margin_m` around it. A ValueError refuses
the settings.
"""


def chooser_of(
    name: str, config: UploadConfig, roadway: Roadway, pattern: ScanPattern
) -> Chooser | None:
    """Returns the chooser of one agent; None if the policy has none.

    Raises:
        ConfigError: the plug-in cannot be imported, refuses its settings or makes no chooser.
    """
    policy = policy_of(name)
    if policy.chooser is None:
        return None
    plugin = NAMES.load(name)
    maker = Plugin(plugin.label, policy.chooser)
    return _CheckedChooser(plugin, maker.make("choose", config, roadway, pattern), policy.chunks)


@dataclass(frozen=True, slots=True, eq=False)
class _CheckedChooser:
    """Checks each choice of a plug-in."""

    plugin: Plugin
    chooser: Chooser
    chunks: int

    def choose(self, scan: RangeScan, map_SE3_sensor: SE3) -> Bytes:
        """See `Chooser.choose`.

        Raises:
            ConfigError: what the plug-in returned are no chunks of these beams.
        """
        chunk = self.chooser.choose(scan, map_SE3_sensor)
        shape = scan.range_m.shape
        if not isinstance(chunk, np.ndarray) or chunk.dtype != np.uint8 or chunk.shape != shape:
            given = f"{getattr(chunk, 'dtype', type(chunk).__name__)} {np.shape(chunk)}"
            raise self.plugin.wrong(f"chose {given}, must be uint8 {shape}")
        if (beyond := chunk[(chunk >= self.chunks) & (chunk != NOT_SENT)]).size:
            raise self.plugin.wrong(
                f"chose chunk {beyond[0]}: it has 0 to {self.chunks - 1}, {NOT_SENT} is not sent"
            )
        return chunk


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
    """Chooses for one agent. That of a stationary sensor learns from scan to scan."""

    def __init__(
        self,
        policy: Policy,
        filters: frozenset[Filter],
        roadway: Roadway,
        pattern: ScanPattern,
        chooser: Chooser | None = None,
        *,
        thin_m: float,
        stationary: bool,
    ) -> None:
        self._policy = policy
        self._roadway = roadway
        self._roi = "roi" in filters
        self._foreground = "foreground" in filters
        self._chooser = chooser
        self._spacing_m = thin_m
        beams = pattern.channels * pattern.columns
        self._background = Background(beams) if stationary and self._foreground else None

    @property
    def is_ground_free(self) -> bool:
        """Whether what is left has no ground."""
        return self._foreground

    def select(
        self, scan: RangeScan, map_SE3_sensor: SE3, agent: str, plan: Plan | None
    ) -> Selection:
        """Returns the chunks of a scan from a sensor at an estimated pose.

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
