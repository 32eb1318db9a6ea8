"""Writes a dataset: labelled scans of many generated junctions."""

from __future__ import annotations

import json
import multiprocessing
import shutil
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from learning.dataset import (
    DESCRIPTION,
    INFO,
    NET,
    NETWORKS,
    POSES,
    ROAD_MAP,
    SPLITS,
    VERSION,
    Info,
    ScanRow,
    Split,
    scan_paths,
    split_path,
    splits,
)
from learning.kitti import CALIB
from learning.scanner import JunctionScanner
from learning.sites import World, draw_site
from protocol.errors import ConfigError

MAX_NETWORKS, MAX_SAMPLES, MAX_FURNITURE_PER_100M = 1000, 500, 30
_PARTS = ".parts"


@dataclass(frozen=True, slots=True)
class DatasetSpec:
    """The arguments of a dataset; equal ones give equal bytes.

    `world` are the sections of a scenario with the realism of this name; None for `paper`. Where a
    `split` is given, the networks of the others are left out; the same networks have equal scans.
    """

    networks: int
    samples: int
    seed: int
    realism: str = "paper"
    world: World | None = None
    split: str | None = None
    furniture_per_100m: float = 0.0

    @property
    def made(self) -> list[tuple[int, Split]]:
        """The networks that are made: number and split."""
        every = enumerate(splits(self.networks))
        return [(number, one) for number, one in every if self.split in (None, one)]


def generate(
    folder: Path, spec: DatasetSpec, jobs: int, report: Callable[[int, int], None] = lambda *_: None
) -> None:
    """Writes the dataset into a folder that must be new or empty.

    Networks are made by `jobs` processes, each one network at a time, and are numbered in
    order. `report` is called after each with the number of networks and of scans.

    Raises:
        ConfigError: a number is out of bounds, the folder holds something, or SUMO fails.
    """
    _check(spec, jobs)
    try:
        _prepare(folder)
        with _emptied_on_failure(folder):
            _write(folder, spec, jobs, report)
    except OSError as error:
        raise ConfigError(f"{error.filename or folder}: {error.strerror or error}") from None


@contextmanager
def _emptied_on_failure(folder: Path) -> Iterator[None]:
    """Empties a folder again if the block does not finish."""
    try:
        yield
    except BaseException:
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        raise


def _write(folder: Path, spec: DatasetSpec, jobs: int, report: Callable[[int, int], None]) -> None:
    by_split = _collect(folder, spec, jobs, report)
    for split, indices in by_split.items():
        text = "".join(f"{index:06d}\n" for index in indices)
        split_path(folder, split).write_text(text, "utf-8")
    (folder / _PARTS).rmdir()
    info = Info(
        version=VERSION,
        networks=spec.networks,
        samples=spec.samples,
        seed=spec.seed,
        realism=spec.realism,
        split=spec.split,
        furniture_per_100m=spec.furniture_per_100m,
    )
    (folder / INFO).write_text(info.model_dump_json(indent=2) + "\n", "utf-8")


def _collect(
    folder: Path, spec: DatasetSpec, jobs: int, report: Callable[[int, int], None]
) -> dict[Split, list[int]]:
    """Numbers the scans of all networks as they come; returns the indices of each split."""
    scans = 0
    by_split: dict[Split, list[int]] = {split: [] for split in SPLITS}
    made = _generated(folder / _PARTS, spec, jobs)
    with (folder / POSES).open("w", encoding="utf-8") as poses:
        for done, ((_, split), (part, rows)) in enumerate(zip(spec.made, made, strict=True), 1):
            for local, row in enumerate(rows):
                here = scan_paths(part, local), scan_paths(folder, scans)
                for source, target in zip(*here, strict=True):
                    source.rename(target)
                poses.write(row.model_copy(update={"index": scans}).model_dump_json() + "\n")
                by_split[split].append(scans)
                scans += 1
            (part / NETWORKS).rename(folder / NETWORKS / part.name)
            shutil.rmtree(part)
            report(done, scans)
    return by_split


def _check(spec: DatasetSpec, jobs: int) -> None:
    limits = {
        "--networks": (spec.networks, 1, MAX_NETWORKS),
        "--samples": (spec.samples, 1, MAX_SAMPLES),
        "--seed": (spec.seed, 0, 2**31 - 1),
        "--furniture": (spec.furniture_per_100m, 0, MAX_FURNITURE_PER_100M),
        "--jobs": (jobs, 1, 256),
    }
    for name, (value, low, high) in limits.items():
        if not low <= value <= high:
            raise ConfigError(f"{name} {value}: must be {low} to {high}")
    if spec.split not in (None, *SPLITS):
        raise ConfigError(f"--split {spec.split}: must be {', '.join(SPLITS)}")
    if not spec.made:
        raise ConfigError(f"--split {spec.split}: fewer than 3 networks are all for training")


def _prepare(folder: Path) -> None:
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: it exists and is not an empty folder")
    for path in (
        *(target.parent for target in scan_paths(folder, 0)),
        split_path(folder, "train").parent,
        folder / NETWORKS,
        folder / _PARTS,
    ):
        path.mkdir(parents=True)


def _generated(parts: Path, spec: DatasetSpec, jobs: int) -> Iterator[tuple[Path, list[ScanRow]]]:
    """Yields each network's folder and its lines of `poses.jsonl`, in the order of numbers."""
    context = multiprocessing.get_context("spawn")
    workers = min(jobs, len(spec.made))
    pool = ProcessPoolExecutor(workers, mp_context=context, initializer=_ignore_interrupt)
    try:
        futures = [pool.submit(_make, parts, spec, number) for number, _ in spec.made]
        for future in futures:
            yield future.result()
    except BrokenProcessPool:
        raise ConfigError(
            "a process that makes networks was killed, perhaps for lack of memory: fewer --jobs "
            "take less"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _ignore_interrupt() -> None:
    """Ignores Ctrl-C in workers: the collecting process handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _make(parts: Path, spec: DatasetSpec, number: int) -> tuple[Path, list[ScanRow]]:
    site = draw_site(spec.seed, number, spec.world, spec.furniture_per_100m)
    try:
        scanner = JunctionScanner(site, spec.samples)
    except ConfigError as error:
        raise ConfigError(f"{site.name}: {error}") from None
    part = parts / site.name
    for path in (*(target.parent for target in scan_paths(part, 0)), part / NETWORKS):
        path.mkdir(parents=True)
    rows = []
    for local, observed in enumerate(scanner.scans()):
        cloud, labels, calib = scan_paths(part, local)
        cloud.write_bytes(observed.points.astype("<f4").tobytes())
        labels.write_text("".join(f"{label.line}\n" for label in observed.labels), "utf-8")
        calib.write_text(CALIB, "utf-8")
        rows.append(observed.row)
    description: dict[str, Any] = site.model_dump(mode="json")
    description["mounts"] = [mount.model_dump(mode="json") for mount in scanner.mounts]
    (part / NETWORKS / NET).write_text(scanner.net, "utf-8")
    (part / NETWORKS / ROAD_MAP).write_text(scanner.road_map.model_dump_json() + "\n", "utf-8")
    (part / NETWORKS / DESCRIPTION).write_text(json.dumps(description, indent=1) + "\n", "utf-8")
    return part, rows
