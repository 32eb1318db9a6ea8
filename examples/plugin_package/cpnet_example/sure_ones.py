"""A fusion: detections that are sure enough, then the rule of a vehicle's length of the paper."""

from __future__ import annotations

import numpy as np

from edge_server.config import FusionConfig
from edge_server.fusion import fuse
from perception.detector import Vehicles
from protocol.messages import AgentPose


class SureOnes:
    """Made once, for a region; called for every frame."""

    def __init__(self, config: FusionConfig, centres: np.ndarray) -> None:
        self._least_score = float(config.plugin.get("least_score", 0.5))
        if not 0 <= self._least_score <= 1:
            raise ValueError(f"least_score is {self._least_score}, must be 0 to 1")
        self._rule = config.model_copy(update={"rule": "radius"})
        self._centres = centres

    def fuse(self, found: Vehicles, poses: list[AgentPose]) -> Vehicles:
        """Returns each vehicle once, agents by their own poses."""
        sure = found.take(found.scores >= self._least_score)
        return fuse(sure, poses, centres=self._centres, config=self._rule)
