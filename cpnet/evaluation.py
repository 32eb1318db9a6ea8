"""`cpnet eval`: measures detectors on samples of a dataset, or of the user's net."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from edge_server.config import EdgeConfig
from learning.dataset import SPLITS, Dataset, SceneSample, Split
from learning.scanner import samples_on
from perception.config import DETECTORS, DetectorName
from protocol.errors import ConfigError
from studies.evaluate import EVERYTHING, Site, evaluate

SEED = 1


@dataclass(frozen=True, slots=True)
class Source:
    """Source of samples: a dataset's split, or a net with a signal."""

    dataset: Path | None
    net: Path | None
    tls: str | None
    split: str
    samples: int

    def open(self, config: EdgeConfig) -> tuple[int, Iterator[tuple[Site, SceneSample]]]:
        """Returns how many samples there are, and the samples with their sites.

        Raises:
            ConfigError: here or while iterating: there is no such source, or it cannot be read.
        """
        if self.net is not None:
            if self.dataset is not None:
                raise ConfigError("give a dataset or --net, not both")
            road_map, made = samples_on(self.net, self.tls, self.samples, SEED)
            site = Site(road_map, config)
            return len(made), ((site, sample) for sample in made)
        if self.dataset is None:
            raise ConfigError("give the folder of a dataset (cpnet dataset OUT), or --net FILE")
        dataset = Dataset(self.dataset)
        listed = dataset.samples(_split(self.split))
        if not listed:
            raise ConfigError(f"{self.dataset}: its split {self.split} is empty")
        return len(listed), _read(dataset, listed, config)


def figures_of(
    dataset: Path, network: DetectorName, weights: Path, split: Split
) -> dict[str, float]:
    """Returns AP40 on a split, of visible vehicles inside the geofence, by cloud, view and IoU.

    Raises:
        ConfigError: the data set cannot be read.
    """
    config = EdgeConfig.model_validate({"pillars": {"weights": str(weights)}})
    _, listed = Source(dataset, None, None, split, 0).open(config)
    rows = evaluate(listed, (network,), geofences=(True,))
    return {
        f"{row.cloud} {row.fusion} {row.view} {row.iou:g} {row.objects}": round(row.ap40, 4)
        for row in rows
        if row.truth == "visible" and row.part == EVERYTHING and row.ap40
    }


def detectors_of(text: str) -> tuple[DetectorName, ...]:
    """Reads names with commas between.

    Raises:
        ConfigError: there is no such detector.
    """
    names = [name.strip() for name in text.split(",")]
    unknown = [name for name in names if not DETECTORS.has(name)]
    if unknown:
        raise ConfigError(f"detector {unknown[0]!r}: must be one of {DETECTORS.listed()}")
    built_in = [name for name in DETECTORS.builtin if name in names]
    return tuple(dict.fromkeys([*built_in, *names]))


def _split(name: str) -> Split:
    for split in SPLITS:
        if split == name:
            return split
    raise ConfigError(f"--split {name}: must be one of {', '.join(SPLITS)}")


def _read(
    dataset: Dataset, listed: list[tuple[str, int]], config: EdgeConfig
) -> Iterator[tuple[Site, SceneSample]]:
    """Yields samples one at a time; a network's site is made once, its samples follow."""
    name, site = "", None
    for network, frame in listed:
        if site is None or network != name:
            name, site = network, Site(dataset.road_map(network), config)
        yield site, dataset.load(network, frame)
