"""`cpnet bench codec`: the codec's profiles, Draco and float32 + zstd at equal maximum error.

Scans are a roadside sensor's and CAVs' in traffic, at the built-in junction. Draco's error at each
of its bit depths is measured, and becomes the bound of all others. Times are medians of one thread;
codecs take turns, so that a busy machine is so for all.
"""

from __future__ import annotations

import math
import sys
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import numpy.typing as npt
import zstandard
from rich.console import Console
from rich.table import Table

from protocol.codec import decode, encode_cloud, encode_scan
from protocol.codec.forms import MIN_BOUND_M
from protocol.errors import CodecError, ConfigError
from protocol.geometry import SE3
from protocol.scans import Floats32, PointCloud, Profile, RangeScan
from sensing.config import LidarConfig, SceneConfig
from sensing.lidar import Lidar, return_probability
from sensing.mesh import VehicleShapes
from sensing.noise import stream
from sensing.point_files import read_points
from sensing.pose import pose_above
from sensing.reflectivity import MIN_RANGE_M
from sensing.scene import scene_of
from sim_host.setup import build_setup
from sim_host.world import sample_traffic
from studies.bench import JsonRow, empty_table, print_whole

CAST_SEED = 1
_WARM_UP_STEPS = 600
_ROADSIDE_HEIGHT_M, _ROOF_HEIGHT_M = 3.0, 2.4
_CAV_DISTANCES_M = (20.0, 60.0, 120.0)  # from the junction's centre


@dataclass(frozen=True, slots=True, eq=False)
class BenchScan:
    """A scan, and what no codec can save on it: range noise, and which beams were lost by chance.

    `noise_std_m` is that of the range noise; `loss_bits` the entropy of the losses, all beams'.
    """

    name: str
    scan: RangeScan
    noise_std_m: float
    loss_bits: float


def cast_scans() -> list[BenchScan]:
    """Casts the scans; the same ones every time."""
    with tempfile.TemporaryDirectory() as folder:
        setup = build_setup({}, Path(folder))
        scene = scene_of(setup, SceneConfig(), CAST_SEED)
        bodies = sample_traffic(setup, Path(folder), scene.terrain, CAST_SEED, [_WARM_UP_STEPS])[0]
    config = LidarConfig()
    lidar = Lidar(config, scene, VehicleShapes.from_setup(setup))
    centre = np.array(setup.road_map.centre[:2])
    ground = scene.terrain.body_poses(centre[:1], centre[1:], np.zeros(1))[0]
    sensors: list[tuple[str, SE3, int | None]] = [
        ("roadside", pose_above(ground, _ROADSIDE_HEIGHT_M), None)
    ]
    away_m = np.linalg.norm(bodies.poses[:, :2] - centre, axis=1)
    for n, wanted_m in enumerate(_CAV_DISTANCES_M):
        car = int(np.argmin(np.abs(away_m - wanted_m)))
        sensors.append((f"cav {n}", pose_above(bodies.poses[car], _ROOF_HEIGHT_M), car))
    result = []
    for name, map_SE3_sensor, own in sensors:
        view = (map_SE3_sensor, bodies.poses, bodies.types, own)
        scan = lidar.scan(*view, stream(CAST_SEED, "bench", name)).scan
        bits = loss_entropy_bits(lidar.view(*view).distance_m, config)
        result.append(BenchScan(name, scan, config.noise_stddev, bits))
    return result


def loss_entropy_bits(distance_m: Floats32, config: LidarConfig) -> float:
    """Returns the entropy of which beams are lost, their true distances being known."""
    seen = distance_m[(distance_m >= MIN_RANGE_M) & (distance_m < config.range)].astype(np.float64)
    kept = return_probability(seen, config)
    lost = 1.0 - kept
    terms = [share * np.log2(np.maximum(share, 1e-12)) for share in (kept, lost)]
    return float(-(terms[0] + terms[1]).sum())


DRACO_BITS = (10, 11, 12, 14)
_LEVEL = 10
FLOOR_BOUND_M = 0.01
OWN = (Profile.FAST, Profile.DEFAULT)
_RUNS = 9
_NORMAL_BITS = math.sqrt(2 * math.pi * math.e)  # 2^entropy of a normal of standard deviation 1
_ZSTD_LEVEL = 3


@dataclass(frozen=True, slots=True, eq=False)
class BenchCloud:
    """What to encode: points (N, 3), and the scan that they came from, if any.

    `noise_std_m` and `loss_bits` are those of a `BenchScan`, 0 where they are not known.
    """

    name: str
    points: Floats32
    scan: RangeScan | None = None
    noise_std_m: float = 0.0
    loss_bits: float = 0.0

    @classmethod
    def of_scan(cls, cast: BenchScan) -> BenchCloud:
        """Returns the returns of a scan, ring by ring."""
        points = cast.scan.cloud().points
        return cls(cast.name, points, cast.scan, cast.noise_std_m, cast.loss_bits)

    @classmethod
    def of_file(cls, path: Path) -> BenchCloud:
        """Returns the points of a file, once it is sure that all codecs take them.

        Raises:
            ConfigError: it cannot be read, or holds no points that could be measured.
        """
        cloud = cls(str(path), read_points(path).points)
        if not len(cloud.points):
            raise ConfigError(f"{path}: holds no point with finite coordinates")
        try:
            for bits in (min(DRACO_BITS), max(DRACO_BITS)):
                for profile in OWN:
                    _own(cloud, profile, bound_beside(cloud.points, bits)).encode()
        except CodecError as error:
            raise ConfigError(f"{path}: at Draco's error it cannot be encoded: {error}") from None
        return cloud


@dataclass(frozen=True, slots=True)
class BenchRow(JsonRow):
    """One codec on one cloud. `bound_m` is the error it was allowed.

    `max_error_m` is the farthest that a point lies from its decoded self. `noise_floor_bits` is
    what range noise costs per point in steps of twice that bound, `loss_floor_bits` what it costs
    to tell which beams were lost; None where not known.
    """

    cloud: str
    codec: str
    points: int
    bytes: int
    bits_per_point: float
    encode_ms: float
    decode_ms: float
    max_error_m: float
    bound_m: float
    noise_floor_bits: float | None
    loss_floor_bits: float | None


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """`encode` makes bytes, `decode` points of them; `error_m` measures what came back."""

    codec: str
    bound_m: float
    encode: Callable[[], bytes]
    decode: Callable[[bytes], Any]
    error_m: Callable[[], float]


def bench(cloud: BenchCloud, runs: int = _RUNS) -> list[BenchRow]:
    """Returns a row for every codec and bound.

    Raises:
        ConfigError: DracoPy is not installed.
    """
    draco = load_draco()
    trials = [_plain(cloud)]
    for bits in DRACO_BITS:
        bound_m = bound_beside(cloud.points, bits)
        trials.append(_draco(draco, cloud, bits, bound_m))
        trials += [_own(cloud, profile, bound_m) for profile in OWN]
    if cloud.scan is not None:
        trials += [_own(cloud, profile, FLOOR_BOUND_M) for profile in OWN]
    times = np.array([[_timed(trial) for trial in trials] for _ in range(runs)])
    medians = np.median(times, axis=0) * 1e3
    return [_row(cloud, trial, *took) for trial, took in zip(trials, medians, strict=True)]


def load_draco() -> ModuleType:
    """Imports DracoPy.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        import DracoPy
    except ModuleNotFoundError:
        raise ConfigError(
            "Draco needs DracoPy, which is not installed (extra `reference`): "
            f"{sys.executable} -m pip install DracoPy"
        ) from None
    module: ModuleType = DracoPy
    return module


def bound_beside(points: Floats32, bits: int) -> float:
    """Returns the bound for a comparison with Draco: its error, or the least that we know."""
    return max(draco_error_m(points, bits), MIN_BOUND_M)


def draco_error_m(points: Floats32, bits: int) -> float:
    """Returns how far Draco moves a point of this cloud at most.

    Draco reorders points, so that its quantisation is repeated here; that it is the same is checked
    against what Draco returns.
    """
    draco = load_draco()
    packed = draco.encode(points, quantization_bits=bits, compression_level=_LEVEL)
    found = np.asarray(draco.decode(packed).points, np.float32)
    low = points.min(axis=0)
    extent = np.float32((points.max(axis=0) - low).max() or 1)  # as Draco takes a single place
    cells = np.float32(2**bits - 1)
    steps = np.floor((points - low) * (cells / extent) + np.float32(0.5))
    moved = steps * (extent / cells) + low
    same = len(found) == len(points) and np.allclose(
        np.sort(found, axis=0), np.sort(moved, axis=0), atol=float(extent / cells) * 1e-2, rtol=0
    )
    if not same:  # half the diagonal of a cell, the most there can be
        return float(extent / cells) * math.sqrt(3) / 2
    return _farthest(moved, points)


def noise_floor_bits(noise_std_m: float, bound_m: float) -> float | None:
    """Returns the entropy of normal noise in steps of twice the bound, for steps that it fills."""
    if noise_std_m <= 0 or bound_m > noise_std_m:
        return None
    return math.log2(noise_std_m * _NORMAL_BITS / (2 * bound_m))


def _row(cloud: BenchCloud, trial: _Trial, encode_ms: float, decode_ms: float) -> BenchRow:
    points, size = len(cloud.points), len(trial.encode())
    return BenchRow(
        cloud=cloud.name,
        codec=trial.codec,
        points=points,
        bytes=size,
        bits_per_point=8 * size / max(points, 1),
        encode_ms=float(encode_ms),
        decode_ms=float(decode_ms),
        max_error_m=trial.error_m(),
        bound_m=trial.bound_m,
        noise_floor_bits=noise_floor_bits(cloud.noise_std_m, trial.bound_m)
        if trial.bound_m > 0
        else None,
        loss_floor_bits=cloud.loss_bits / points if cloud.loss_bits and points else None,
    )


def _timed(trial: _Trial) -> tuple[float, float]:
    """Returns the seconds that encoding and decoding take."""
    start = time.perf_counter()
    packed = trial.encode()
    between = time.perf_counter()
    trial.decode(packed)
    return between - start, time.perf_counter() - between


def _plain(cloud: BenchCloud) -> _Trial:
    def encode() -> bytes:
        return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(cloud.points.tobytes())

    def unpack(packed: bytes) -> Floats32:
        raw = zstandard.ZstdDecompressor().decompress(packed, max_output_size=cloud.points.nbytes)
        return np.frombuffer(raw, np.float32).reshape(-1, 3)

    return _Trial("float32+zstd", 0.0, encode, unpack, lambda: 0.0)


def _draco(draco: Any, cloud: BenchCloud, bits: int, bound_m: float) -> _Trial:  # noqa: ANN401 - DracoPy is untyped
    def encode() -> bytes:
        packed: bytes = draco.encode(cloud.points, quantization_bits=bits, compression_level=_LEVEL)
        return packed

    def unpack(packed: bytes) -> npt.NDArray[Any]:
        return np.asarray(draco.decode(packed).points)

    return _Trial(
        f"draco-{bits}", bound_m, encode, unpack, lambda: draco_error_m(cloud.points, bits)
    )


def _own(cloud: BenchCloud, profile: Profile, bound_m: float) -> _Trial:
    scan = cloud.scan
    if scan is not None:

        def encode() -> bytes:
            return encode_scan(scan, bound_m, profile=profile)

        def error_m() -> float:
            return _farthest(decode(encode()).points, scan.cloud().points)

        return _Trial(profile.value, bound_m, encode, decode, error_m)
    bare = PointCloud(cloud.points, np.zeros(len(cloud.points), np.float32))
    return _Trial(
        profile.value,
        bound_m,
        lambda: encode_cloud(bare, bound_m, profile=profile),
        decode,
        lambda: cloud_error_m(cloud.points, profile, bound_m),
    )


def cloud_error_m(points: Floats32, profile: Profile, bound_m: float) -> float:
    """Returns how far a codec that reorders points moves them at most.

    The index of each point is sent along as intensity, one byte after the other.
    """
    names = np.zeros(len(points), np.int64)
    for digit in range(3):
        shade = ((np.arange(len(points)) >> (8 * digit)) & 255).astype(np.float32) / np.float32(255)
        cloud = PointCloud(points, shade)
        back = decode(encode_cloud(cloud, bound_m, profile=profile, intensity=True))
        names |= np.round(back.intensity * 255).astype(np.int64) << (8 * digit)
    return _farthest(back.points, points[names])


def _farthest(found: Floats32, points: Floats32) -> float:
    away = found.astype(np.float64) - points.astype(np.float64)
    return float(np.linalg.norm(away, axis=1).max(initial=0.0))


_BLANK = "–"
_NAME_WIDTH = 24


def print_bench(rows: list[BenchRow], console: Console) -> None:
    """Prints a table for each cloud, then the least favourable ratios of each profile."""
    for name in dict.fromkeys(row.cloud for row in rows):
        print_whole(_cloud_table(name, [row for row in rows if row.cloud == name]), console)
    print_whole(_summary_table(rows), console)


def _short(name: str) -> str:
    return name if len(name) <= _NAME_WIDTH else f"…{name[1 - _NAME_WIDTH :]}"


def _cloud_table(name: str, rows: list[BenchRow]) -> Table:
    table = empty_table(
        ("codec", "bound\ncm", "error\ncm", "bytes", "bits/\npoint", "enc.\nms",
         "dec.\nms", "of\nDraco", "enc.\nx", "dec.\nx"),
        title=f"{_short(name)}, {rows[0].points} points (of, x: beside Draco at this error)",
    )  # fmt: skip
    bound_m = rows[0].bound_m
    for row in rows:
        if row.bound_m != bound_m:
            table.add_section()
            bound_m = row.bound_m
        draco = draco_beside(row, rows)
        ratios = [_BLANK] * 3
        if draco is not None and draco is not row:
            ratios = [f"{ratio(row, draco):.2f}" for ratio in _RATIOS.values()]
        table.add_row(
            row.codec,
            f"{100 * row.bound_m:.2f}",
            f"{100 * row.max_error_m:.2f}",
            str(row.bytes),
            f"{row.bits_per_point:.2f}",
            f"{row.encode_ms:.2f}",
            f"{row.decode_ms:.2f}",
            *ratios,
        )
    return table


def draco_beside(row: BenchRow, rows: Iterable[BenchRow]) -> BenchRow | None:
    """Returns Draco's row on the same cloud with the same error."""
    for other in rows:
        same = other.cloud == row.cloud and other.bound_m == row.bound_m
        if same and other.codec.startswith("draco"):
            return other
    return None


_RATIOS: dict[str, Callable[[BenchRow, BenchRow], float]] = {
    "bytes": lambda row, draco: row.bytes / draco.bytes,
    "encode": lambda row, draco: draco.encode_ms / row.encode_ms,
    "decode": lambda row, draco: draco.decode_ms / row.decode_ms,
}


def _summary_table(rows: list[BenchRow]) -> Table:
    """Beside Draco at equal error: mean and worst over clouds, by codec and bits."""
    table = empty_table(
        ("clouds", "codec", "Draco's\nbits", "bytes /\nDraco", "worst", "encode\nx Draco", "worst",
         "decode\nx Draco", "worst"),
        title="beside Draco at equal maximum error: mean and least favourable cloud", left=2,
    )  # fmt: skip
    groups: dict[tuple[str, str, str], list[tuple[BenchRow, BenchRow]]] = {}
    for row in rows:
        draco = draco_beside(row, rows)
        if draco is not None and draco is not row:
            kind = "scans" if row.loss_floor_bits is not None else "files"
            key = (kind, row.codec, draco.codec.removeprefix("draco-"))
            groups.setdefault(key, []).append((row, draco))
    for key in sorted(groups, key=lambda key: (key[0] != "scans", key[1], int(key[2]))):
        cells = []
        for name, ratio in _RATIOS.items():
            values = [ratio(row, draco) for row, draco in groups[key]]
            worst = max(values) if name == "bytes" else min(values)
            cells += [f"{sum(values) / len(values):.2f}", f"{worst:.2f}"]
        table.add_row(*key, *cells)
    return table
