"""Policies that choose beam by beam, as another package may bring them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.plugins import Plugin
from protocol.scans import RangeScan, ScanPattern
from sensing.config import UploadConfig
from sensing.upload.cells import NOT_SENT, Bytes
from sensing.upload.registry import NAMES, policy_of


class Chooser(Protocol):
    """Chooses for one agent, scan by scan; it may learn from one scan to the next."""

    def choose(self, scan: RangeScan, map_SE3_sensor: SE3) -> Bytes:
        """Returns the chunk (channels, columns) of each beam, 255 for those that are not sent.

        Chunks leave in the order of their numbers, from 0 to one less than the policy's `chunks`;
        what a slow uplink has not taken when the next frame begins stays behind.

        Args:
            scan: range in m and intensity by ring and column; a range of 0 is no return. It must
                not be changed.
            map_SE3_sensor: where the agent believes its sensor to be, map frame, m.
        """


ChooserMaker = Callable[[UploadConfig, Roadway, ScanPattern], Chooser]
"""Makes the chooser of one agent; the settings of a plug-in are `plugin` of the configuration.

The roadway is the map's road with `upload.roi_margin_m` around it. A ValueError says that the
settings cannot be.
"""


def chooser_of(
    name: str, config: UploadConfig, roadway: Roadway, pattern: ScanPattern
) -> Chooser | None:
    """Returns what chooses for one agent; None if the policy takes no choice of its own.

    Raises:
        ConfigError: the plug-in cannot be imported, refuses its settings or makes no chooser.
    """
    policy = policy_of(name)
    if policy.chooser is None:
        return None
    plugin = NAMES.load(name)
    maker = Plugin(plugin.label, policy.chooser)
    return _Held(plugin, maker.make("choose", config, roadway, pattern), policy.chunks)


@dataclass(frozen=True, slots=True, eq=False)
class _Held:
    """Holds a plug-in to what every chooser promises, scan by scan."""

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
            told = f"{getattr(chunk, 'dtype', type(chunk).__name__)} {np.shape(chunk)}"
            raise self.plugin.wrong(f"chose {told}, must be uint8 {shape}")
        if (beyond := chunk[(chunk >= self.chunks) & (chunk != NOT_SENT)]).size:
            raise self.plugin.wrong(
                f"chose chunk {beyond[0]}: it has 0 to {self.chunks - 1}, {NOT_SENT} is not sent"
            )
        return chunk
