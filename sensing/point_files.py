"""Readers of point clouds in common file formats (KITTI, nuScenes, Argoverse 2, PCL, PLY).

| file | holds |
|---|---|
| `.bin` | KITTI's rows of four float32: x, y, z, reflectance |
| `.pcd.bin` | nuScenes' rows of five float32: x, y, z, intensity, ring |
| `.feather` | Argoverse 2's table: x, y, z, intensity and more |
| `.npy` | an array (N, 3 or more), x, y, z, intensity first; or one with these fields |
| `.pcd` | see `sensing.pcd` |
| `.ply` | see `sensing.ply` |

A `.bin` that can be rows of five only is read as such. Where its size allows both, its numbers
decide: rings are whole numbers, and neither ring nor reflectance is below 0.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from perception.arrays import Floats
from protocol.config import is_file, is_folder
from protocol.errors import ConfigError
from protocol.scans import PointCloud
from sensing.feather import read_feather
from sensing.limits import MAX_CLOUD_FILE_BYTES, MAX_RECORD_BYTES
from sensing.pcd import AXES, Columns, read_pcd
from sensing.ply import read_ply

_KNOWN = (".bin", ".feather", ".npy", ".pcd", ".ply")
KNOWN = f"{', '.join(_KNOWN[:-1])} and {_KNOWN[-1]}"
_FULL_SCALES = (1.0, 255.0, 65535.0)  # of intensities: shares, bytes, two bytes
_NUSCENES = ".pcd.bin"
_MOST_HEADER = 1 << 16  # of an array


def point_files(paths: Iterable[Path]) -> list[Path]:
    """Returns the files among these, and in place of a folder all known ones under it, sorted.

    Raises:
        ConfigError: a path does not exist, or a folder holds no such file.
    """
    result: list[Path] = []
    for path in paths:
        if is_file(path):
            result.append(path)
            continue
        if not is_folder(path):
            raise ConfigError(f"{path} does not exist")
        found = sorted(
            file for file in path.rglob("*") if file.suffix.lower() in _KNOWN and file.is_file()
        )
        if not found:
            raise ConfigError(f"{path} holds no {KNOWN.replace(' and ', ' or ')} file")
        result += found
    return result


def read_points(path: Path) -> PointCloud:
    """Reads a cloud (N, 3) in the sensor frame; points that are not finite are dropped.

    Intensities are shares of the full scale, which is 1, 255 or 65535, whichever holds them all;
    zeros if the file has none.

    Raises:
        ConfigError: the file is missing, of another kind, or not what its header says.
    """
    readers = {
        ".bin": _read_nuscenes if path.name.lower().endswith(_NUSCENES) else _read_bin,
        ".feather": lambda data: _named(read_feather(data)),
        ".npy": _read_npy,
        ".pcd": read_pcd,
        ".ply": read_ply,
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(f"{path}: cannot read {path.suffix or 'this'}; known are {KNOWN}")
    try:
        if path.stat().st_size > MAX_CLOUD_FILE_BYTES:
            raise ConfigError(
                f"{path} has {path.stat().st_size} bytes, limit {MAX_CLOUD_FILE_BYTES}"
            )
        data = path.read_bytes()
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from None
    # What float32 does not hold is not finite either; NaN may come as one that signals.
    with np.errstate(over="ignore", invalid="ignore"):
        try:
            columns = reader(data)
        except ValueError as error:
            raise ConfigError(f"{path}: {error}") from None
        points = np.stack([columns[axis] for axis in AXES], axis=1).astype(np.float32)
        shade = columns.get("intensity", np.zeros(len(points))).astype(np.float32)
    finite = np.isfinite(points).all(axis=1)
    points, shade = points[finite], np.nan_to_num(shade[finite], posinf=0.0, neginf=0.0)
    most = float(shade.max(initial=0.0))
    scale = next((scale for scale in _FULL_SCALES if most <= scale), most)
    return PointCloud(points, shade / np.float32(scale))


def _read_bin(data: bytes) -> Columns:
    """Reads rows of four or five float32, whichever these are."""
    four = _rows(data, 4) if len(data) % 16 == 0 else None
    five = _rows(data, 5) if len(data) % 20 == 0 else None
    if four is not None and _not_below_0(four[:, 3]):
        return _columns(four)
    if five is not None and _are_rings(five[:, 4]) and _not_below_0(five[:, 3]):
        return _columns(five)
    raise ValueError(
        f"{len(data)} bytes are neither KITTI's rows of four float32 (x, y, z, reflectance of 0 "
        "or more) nor nuScenes' of five (x, y, z, intensity, ring; such a file ends in .pcd.bin)"
    )


def _read_nuscenes(data: bytes) -> Columns:
    if len(data) % 20:
        raise ValueError(
            f"{len(data)} bytes are no rows of five float32, as a .pcd.bin of nuScenes has them: "
            "x, y, z, intensity, ring. KITTI's rows of four are a plain .bin"
        )
    rows = _rows(data, 5)
    if not _are_rings(rows[:, 4]):
        raise ValueError(
            "the last of five float32 in a row must be a ring, a whole number from 0 to 255, as "
            "in a .pcd.bin of nuScenes. KITTI's rows of four are a plain .bin"
        )
    return _columns(rows)


def _rows(data: bytes, width: int) -> Floats:
    return np.frombuffer(data, "<f4").reshape(-1, width).astype(np.float64)


def _columns(rows: Floats) -> Columns:
    return dict(zip((*AXES, "intensity"), rows.T[:4], strict=False))


def _not_below_0(shade: Floats) -> bool:
    return not bool((shade < 0).any())


def _are_rings(ring: Floats) -> bool:
    return bool(((ring >= 0) & (ring < 256) & (ring == np.floor(ring))).all())


def _read_npy(data: bytes) -> Columns:
    shape, by_column, kind, body = _npy_header(data)
    wanted = int(np.prod(shape, dtype=object)) * kind.itemsize
    if kind.hasobject or kind.itemsize > MAX_RECORD_BYTES or not 0 <= wanted <= len(body):
        raise ValueError(f"{len(body)} bytes for an array {shape} of {kind!s:.80}")
    if kind.names and len(shape) == 1:
        table = np.frombuffer(body[:wanted], kind)
        return _named({name: table[name] for name in kind.names})
    if len(shape) != 2 or shape[1] < 3 or kind.kind not in "fiu":
        raise ValueError(f"an array {shape} of {kind!s:.80}; needed is (N, 3 or more) of numbers")
    array = np.frombuffer(body[:wanted], kind).reshape(shape, order="F" if by_column else "C")
    return _columns(array.astype(np.float64))


def _npy_header(data: bytes) -> tuple[tuple[int, ...], bool, np.dtype[np.generic], bytes]:
    """Returns an array's shape, whether columns come first, its kind, and what follows.

    Not by `numpy.lib.format`: of headers that are no Python of today it asks a tokenizer.
    """
    wide = 2 if data[6:7] == b"\x01" else 4
    end = 8 + wide + int.from_bytes(data[8 : 8 + wide], "little")
    if not data.startswith(b"\x93NUMPY") or end > min(len(data), _MOST_HEADER):
        raise ValueError("is no array of NumPy")
    try:
        header = ast.literal_eval(data[8 + wide : end].decode("latin1"))
        shape = tuple(operator.index(side) for side in header["shape"])
        kind = np.lib.format.descr_to_dtype(header["descr"])
        return shape, bool(header["fortran_order"]), kind, data[end:]
    except (LookupError, MemoryError, RecursionError, SyntaxError, TypeError, ValueError) as error:
        raise ValueError(f"is no array of NumPy: {error!s:.80}") from None


def _named(fields: Mapping[str, npt.NDArray[np.generic]]) -> Columns:
    if missing := [axis for axis in AXES if axis not in fields]:
        raise ValueError(f"no column {missing[0]} of numbers; it has {', '.join(fields):.200}")
    names = [name for name in (*AXES, "intensity") if name in fields]
    for name in names:
        if fields[name].dtype.kind not in "fiu":
            raise ValueError(f"the column {name} is of {fields[name].dtype}, must be numbers")
    return {name: fields[name].astype(np.float64) for name in names}
