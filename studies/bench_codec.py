"""Codecs beside each other at equal maximum error: this project's profiles, Draco, float32 + zstd.

Draco's error is what it is: for each of its bit depths it is measured, and becomes the bound of all
others.
Times are medians of one thread; codecs take turns, so that a busy machine is so for all.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import zstandard

from protocol.codec import decode, encode_cloud, encode_scan
from protocol.codec.draco import LEVEL, load_draco
from protocol.codec.forms import MIN_BOUND_M
from protocol.errors import CodecError, ConfigError
from protocol.scans import Floats32, PointCloud, Profile, RangeScan
from sensing.point_files import read_points
from studies.bench_scans import BenchScan

DRACO_BITS = (10, 11, 12, 14)
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
class BenchRow:
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

    def as_json(self) -> dict[str, Any]:
        """Returns the row with stable keys."""
        return asdict(self)


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


def bound_beside(points: Floats32, bits: int) -> float:
    """Returns the bound for a comparison with Draco: its error, or the least that we know."""
    return max(draco_error_m(points, bits), MIN_BOUND_M)


def draco_error_m(points: Floats32, bits: int) -> float:
    """Returns how far Draco moves a point of this cloud at most.

    Draco reorders points, so that its quantisation is repeated here; that it is the same is checked
    against what Draco returns.
    """
    draco = load_draco()
    packed = draco.encode(points, quantization_bits=bits, compression_level=LEVEL)
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
        packed: bytes = draco.encode(cloud.points, quantization_bits=bits, compression_level=LEVEL)
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
