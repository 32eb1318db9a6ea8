"""The moments of a data set made ready, kept in memory as far as there is room."""

from __future__ import annotations

from functools import lru_cache

from learning.dataset import Dataset
from learning.examples import Roads, Sight
from learning.layout import Split

KEPT_BYTES = 8 << 30


class DatasetSights:
    """One split of a data set."""

    def __init__(self, dataset: Dataset, split: Split) -> None:
        self._dataset = dataset
        self._moments = dataset.moments(split)
        self._kept: dict[int, Sight] = {}
        self._kept_bytes = 0
        self._roads = lru_cache(64)(lambda network: Roads(dataset.road_map(network)))

    def __len__(self) -> int:
        return len(self._moments)

    def __getitem__(self, index: int) -> Sight:
        """Returns a moment, read again if there was no room for it.

        Raises:
            ConfigError: its files cannot be read.
        """
        sight = self._kept.get(index)
        if sight is None:
            network, frame = self._moments[index]
            sight = self._roads(network).sight(self._dataset.load(network, frame))
            size_bytes = sum(points.nbytes * 2 for points in sight.points)
            if self._kept_bytes + size_bytes <= KEPT_BYTES:
                self._kept[index] = sight
                self._kept_bytes += size_bytes
        return sight
