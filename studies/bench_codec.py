"""`cpnet bench codec`: the codec's profiles beside other codecs at equal maximum error.

Scans are a roadside sensor's and CAVs' in traffic, at the built-in junction; clouds are what other
kinds of LiDAR see there (`studies.sensor_clouds`), and files. All codecs get the same bound.
Draco's grid is as coarse as the bound allows: its step puts the corners of a cell one bound from
its middle, whatever the number of bits. Times are CPU times of one thread, medians; codecs take
turns, so that load of the machine affects all.
"""

from __future__ import annotations

import importlib
import math
import sys
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
from protocol.errors import CodecError, ConfigError
from protocol.scans import Floats32, PointCloud, Profile, RangeScan
from sensing.point_files import read_points
from sensing.pose import pose_above
from studies.bench import JsonRow, empty_table, print_whole
from studies.bench_scans import CAST_SEED, CAV_DISTANCES_M, ROOF_HEIGHT_M, BenchScan, Junction
from studies.sensor_clouds import sensor_clouds

BOUNDS_M = (0.01, 0.02, 0.05, 0.1)
STRUCTURED, SIMULATED, FILE = "structured", "simulated", "file"
DRACO = "draco"
_LEVEL = 7  # of 10: as few bytes as the highest, in less time
_DRACO_MAX_BITS = 30
_DRACO_ROOM = 1.0 - 1e-3  # of the bound: the rest is float32's
OWN = (Profile.FAST, Profile.DEFAULT)
_RUNS = 9
_NORMAL_BITS = math.sqrt(2 * math.pi * math.e)  # 2^entropy of a normal of standard deviation 1
_ZSTD_LEVEL = 3


@dataclass(frozen=True, slots=True, eq=False)
class BenchCloud:
    """What to encode: points (N, 3), and the scan that they came from, if any.

    `kind` is structured, simulated or file. `noise_std_m` and `loss_bits` are those of a
    `BenchScan`, 0 where they are not known.
    """

    name: str
    points: Floats32
    kind: str
    scan: RangeScan | None = None
    noise_std_m: float = 0.0
    loss_bits: float = 0.0

    @classmethod
    def of_scan(cls, cast: BenchScan) -> BenchCloud:
        """Returns the returns of a scan, ring by ring."""
        points = cast.scan.cloud().points
        return cls(cast.name, points, STRUCTURED, cast.scan, cast.noise_std_m, cast.loss_bits)

    @classmethod
    def of_file(cls, path: Path) -> BenchCloud:
        """Reads the points of a file, and checks that all codecs accept them.

        Raises:
            ConfigError: it cannot be read, or holds no points that could be measured.
        """
        name = f"{path.parent.name}/{path.name}"
        cloud = cls(name, np.ascontiguousarray(read_points(path).points), FILE)
        if not len(cloud.points):
            raise ConfigError(f"{path}: holds no point with finite coordinates")
        try:
            for profile in OWN:
                _own(cloud, profile, min(BOUNDS_M)).encode()
            DracoGrid.of(cloud.points, min(BOUNDS_M))
        except CodecError as error:
            raise ConfigError(f"{path}: at 1 cm it cannot be encoded: {error}") from None
        return cloud


def cast_clouds(junction: Junction) -> list[BenchCloud]:
    """Casts clouds of other kinds of sensor on a CAV's roof; the same ones every time."""
    own = junction.car_at(CAV_DISTANCES_M[0])
    map_SE3_sensor = pose_above(junction.bodies.poses[own], ROOF_HEIGHT_M)
    cast = sensor_clouds(junction.mesh_without(own), map_SE3_sensor, CAST_SEED)
    return [BenchCloud(name, points, SIMULATED) for name, points in cast]


@dataclass(frozen=True, slots=True)
class BenchRow(JsonRow):
    """One codec on one cloud. `bound_m` is the error it was allowed.

    `kind` is the cloud's. `max_error_m` is the farthest that a point lies from its decoded self.
    `noise_floor_bits` is what range noise costs per point in steps of twice that bound,
    `loss_floor_bits` what it costs to code which beams were lost; None where not known.
    """

    cloud: str
    kind: str
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
    """A codec under test: `encode` makes bytes, `decode` points; `error_m` measures the error."""

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
    for bound_m in BOUNDS_M:
        trials.append(_draco(draco, cloud, bound_m))
        trials += [_own(cloud, profile, bound_m) for profile in OWN]
        trials += _images(cloud, bound_m)
    times = np.array([[_timed(trial) for trial in trials] for _ in range(runs)])
    medians = np.median(times, axis=0) * 1e3
    return [_row(cloud, trial, *took) for trial, took in zip(trials, medians, strict=True)]


def load_draco() -> ModuleType:
    """Imports DracoPy.

    Raises:
        ConfigError: it is not installed.
    """
    return _reference("DracoPy", "Draco")


def _reference(module: str, what: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError:
        raise ConfigError(
            f"{what} needs {module}, which is not installed (extra `reference`): "
            f"{sys.executable} -m pip install {module}"
        ) from None


@dataclass(frozen=True, slots=True, eq=False)
class DracoGrid:
    """The grid of Draco's quantisation: `low` (3,), its step, the bits of a line's number."""

    low: Floats32
    step_m: float
    bits: int

    @classmethod
    def of(cls, points: Floats32, bound_m: float) -> DracoGrid:
        """Returns the coarsest grid whose cells reach no farther than the bound from their middle.

        Raises:
            CodecError: the cloud is too wide for it.
        """
        low = points.min(axis=0)
        step_m = 2.0 / math.sqrt(3.0) * bound_m * _DRACO_ROOM
        extent_m = float((points.max(axis=0) - low).max())
        bits = max(1, math.ceil(math.log2(extent_m / step_m + 1)))
        if bits > _DRACO_MAX_BITS:
            raise CodecError(f"a coordinate lies {extent_m:g} m from another, too far for Draco")
        return cls(low, step_m, bits)

    @property
    def extent_m(self) -> float:
        """From the first to the last line."""
        lines: int = 2**self.bits
        return self.step_m * (lines - 1)

    def encode(self, draco: Any, points: Floats32) -> bytes:  # noqa: ANN401 - DracoPy is untyped
        """Returns Draco's bytes."""
        packed: bytes = draco.encode(
            points,
            quantization_bits=self.bits,
            compression_level=_LEVEL,
            quantization_range=self.extent_m,
            quantization_origin=self.low.tolist(),
        )
        return packed


def draco_error_m(points: Floats32, bound_m: float) -> float:
    """Returns how far Draco moves a point of this cloud at most.

    Draco reorders points, so that its quantisation is repeated here; that it is the same is checked
    against what Draco returns.
    """
    draco, grid = load_draco(), DracoGrid.of(points, bound_m)
    found = np.asarray(draco.decode(grid.encode(draco, points)).points, np.float32)
    step = np.float32(grid.step_m)
    moved = np.floor((points - grid.low) / step + np.float32(0.5)) * step + grid.low
    same = len(found) == len(points) and np.allclose(
        np.sort(found, axis=0), np.sort(moved, axis=0), atol=0.02 * grid.step_m, rtol=0
    )
    if not same:  # half the diagonal of a cell, the most there can be
        return grid.step_m * math.sqrt(3) / 2
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
        kind=cloud.kind,
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
    """Returns the seconds of CPU time that encoding and decoding take."""
    start = time.thread_time()
    packed = trial.encode()
    between = time.thread_time()
    trial.decode(packed)
    return between - start, time.thread_time() - between


def _plain(cloud: BenchCloud) -> _Trial:
    def encode() -> bytes:
        return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(cloud.points.tobytes())

    def unpack(packed: bytes) -> Floats32:
        raw = zstandard.ZstdDecompressor().decompress(packed, max_output_size=cloud.points.nbytes)
        return np.frombuffer(raw, np.float32).reshape(-1, 3)

    return _Trial("float32+zstd", 0.0, encode, unpack, lambda: 0.0)


def _draco(draco: Any, cloud: BenchCloud, bound_m: float) -> _Trial:  # noqa: ANN401 - DracoPy is untyped
    grid = DracoGrid.of(cloud.points, bound_m)

    def unpack(packed: bytes) -> npt.NDArray[Any]:
        return np.asarray(draco.decode(packed).points)

    def error_m() -> float:
        return draco_error_m(cloud.points, bound_m)

    return _Trial(DRACO, bound_m, lambda: grid.encode(draco, cloud.points), unpack, error_m)


_IMAGE_CODECS = {"jpeg-xl": "jpegxl", "jpeg-ls": "jpegls"}
_U16_STEPS = 65_535


def _images(cloud: BenchCloud, bound_m: float) -> list[_Trial]:
    """Returns image codecs on the range image, if there is one and they are installed."""
    scan = cloud.scan
    if scan is None:
        return []
    try:
        codecs = _reference("imagecodecs", "JPEG XL")
    except ConfigError:
        return []
    return [_image(codecs, name, scan, bound_m) for name in _IMAGE_CODECS]


def _image(codecs: Any, name: str, scan: RangeScan, bound_m: float) -> _Trial:  # noqa: ANN401 - untyped
    """Returns lossless compression of the steps of range, and of a mask of the beams that returned.

    A lost beam holds the range of the beam before, which costs least.
    """
    pack = getattr(codecs, f"{_IMAGE_CODECS[name]}_encode")
    unpack_image = getattr(codecs, f"{_IMAGE_CODECS[name]}_decode")
    step_m = 2.0 * bound_m * _DRACO_ROOM

    def encode() -> bytes:
        there = scan.range_m > 0
        last = np.maximum.accumulate(np.where(there, np.arange(there.shape[1]), 0), axis=1)
        filled = np.take_along_axis(scan.range_m, last, axis=1)
        steps = np.clip(np.round(filled / step_m), 0, _U16_STEPS).astype(np.uint16)
        parts = [pack(steps), pack(there.astype(np.uint8))]
        return b"".join(len(part).to_bytes(4, "little") + part for part in parts)

    def unpack(packed: bytes) -> Floats32:
        first = 4 + int.from_bytes(packed[:4], "little")
        there = unpack_image(packed[first + 4 :]) > 0
        range_m = unpack_image(packed[4:first])[there] * np.float32(step_m)
        found: Floats32 = scan.pattern.directions[there] * range_m[:, None]
        return found

    return _Trial(
        name, bound_m, encode, unpack, lambda: _farthest(unpack(encode()), scan.cloud().points)
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
_NAME_WIDTH = 30
_RATIOS: dict[str, Callable[[BenchRow, BenchRow], float]] = {
    "bytes": lambda row, draco: row.bytes / draco.bytes,
    "encode": lambda row, draco: draco.encode_ms / row.encode_ms,
    "decode": lambda row, draco: draco.decode_ms / row.decode_ms,
}


def print_bench(rows: list[BenchRow], console: Console) -> None:
    """Prints a table for each cloud, then all kinds of sensor beside Draco."""
    for name in dict.fromkeys(row.cloud for row in rows):
        print_whole(_cloud_table(name, [row for row in rows if row.cloud == name]), console)
    print_whole(_kinds_table(rows), console)


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
    """Returns Draco's row on the same cloud with the same bound."""
    for other in rows:
        same = other.cloud == row.cloud and other.bound_m == row.bound_m
        if same and other.codec == DRACO:
            return other
    return None


def _kinds_table(rows: list[BenchRow]) -> Table:
    """Profile `default` by kind of sensor: bits a point and ratio to Draco, by bound."""
    heads = [f"{100 * bound:g} cm\n{what}" for bound in BOUNDS_M for what in ("bits", "of Draco")]
    table = empty_table(
        ("cloud", "", *heads, "enc. x\nleast", "dec. x\nleast"),
        title="`default` by sensor: bits a point, share of Draco's bytes, speed beside Draco's",
        left=2,
    )
    for name in dict.fromkeys(row.cloud for row in rows):
        own = [row for row in rows if row.cloud == name and row.codec == Profile.DEFAULT]
        cells, speeds = [], []
        for row in own:
            draco = draco_beside(row, rows)
            if draco is not None:
                values = {what: ratio(row, draco) for what, ratio in _RATIOS.items()}
                cells += [f"{row.bits_per_point:.2f}", f"{values['bytes']:.2f}"]
                speeds.append((values["encode"], values["decode"]))
        if speeds:
            least = (f"{min(column):.2f}" for column in zip(*speeds, strict=True))
            table.add_row(_short(name), own[0].kind, *cells, *least)
    return table
