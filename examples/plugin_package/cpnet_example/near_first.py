"""An upload policy: what is near goes first; the rest follows if the uplink has time for it."""

from __future__ import annotations

import numpy as np

from perception.roadway import Roadway
from protocol.geometry import SE3
from protocol.scans import RangeScan, ScanPattern
from sensing.config import UploadConfig
from sensing.upload_policies import Policy


class NearFirst:
    """Made for each agent; called for every scan."""

    def __init__(self, config: UploadConfig, roadway: Roadway, pattern: ScanPattern) -> None:
        self._near_m = float(config.plugin.get("near_m", 40.0))
        if self._near_m <= 0:
            raise ValueError(f"near_m is {self._near_m}, must be more than 0")

    def choose(self, scan: RangeScan, map_SE3_sensor: SE3) -> np.ndarray:
        """Returns chunk 0 for near returns, 1 for far ones (channels, columns)."""
        return (scan.range_m > self._near_m).astype(np.uint8)


NEAR_FIRST = Policy(
    "no ground or background, near returns first",
    filters=("foreground",),
    chunks=2,
    chooser=NearFirst,
)
