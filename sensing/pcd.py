"""Reader of the Point Cloud Library's .pcd files: ascii, binary and binary_compressed.

Not by `pypcd4`: it refuses files without COUNT or WIDTH, reads truncated files as shorter ones and
allocates what a header claims.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from sensing.limits import MAX_RECORD_BYTES

AXES = ("x", "y", "z")
Columns = dict[str, npt.NDArray[np.float64]]
"""Numbers (N,) by name: x, y, z, and intensity if a file has it."""


def decompress(data: bytes, size: int) -> bytes:
    """Decompresses LZF to exactly `size` bytes; never more are written.

    Raises:
        ValueError: the data is damaged or holds another number of bytes.
    """
    out = bytearray()
    at = 0
    try:
        while at < len(data) and len(out) <= size:
            control = data[at]
            at += 1
            if control < 32:  # that many bytes and one more, as they are
                out += data[at : at + control + 1]
                at += control + 1
                continue
            length = control >> 5
            if length == 7:
                length += data[at]
                at += 1
            start = len(out) - ((control & 31) << 8) - data[at] - 1
            at += 1
            if start < 0:
                raise ValueError("compressed data refers to what lies before its beginning")
            _repeat(out, start, length + 2)
    except IndexError:
        raise ValueError("compressed data ends too early") from None
    if len(out) != size:
        raise ValueError(f"compressed data holds {len(out)} bytes or more, {size} are expected")
    return bytes(out)


def _repeat(out: bytearray, start: int, length: int) -> None:
    """Appends what stands at `start`, which may run into what is being appended."""
    period = bytes(out[start : start + length])
    turns = -(-length // len(period))  # what is there is one period, if it is too short
    out += (period * turns)[:length]


_KINDS = {"F": "f", "U": "u", "I": "i"}
_SIZES = {"f": (4, 8), "u": (1, 2, 4, 8), "i": (1, 2, 4, 8)}


def read_pcd(data: bytes) -> Columns:
    """Reads a file's bytes.

    Raises:
        ValueError: they are not what their header says.
    """
    header, body = _split(data)
    record, points = _record(header), _whole(header, "POINTS")
    kind = header["DATA"][0] if header["DATA"] else ""
    if kind == "ascii":
        rows = _ascii_rows(body, record, points)
    elif kind == "binary":
        rows = _binary_rows(body, record, points)
    elif kind == "binary_compressed":
        rows = _compressed_rows(body, record, points)
    else:
        raise ValueError(f"DATA {kind!r}: known are ascii, binary and binary_compressed")
    names = [name for name in (*AXES, "intensity") if name in (record.names or ())]
    return {name: rows[name].astype(np.float64) for name in names}


def _split(data: bytes) -> tuple[dict[str, list[str]], bytes]:
    """Returns the words behind each key of the header, and what follows the header."""
    header: dict[str, list[str]] = {}
    at = 0
    while "DATA" not in header:
        end = data.find(b"\n", at)
        if end < 0 or end > 1 << 16:
            raise ValueError("no line DATA within its header")
        words = data[at:end].decode("ascii", "replace").split()
        at = end + 1
        if words and not words[0].startswith("#"):
            header[words[0]] = words[1:]
    return header, data[at:]


def _record(header: Mapping[str, list[str]]) -> np.dtype[np.void]:
    """Returns the layout of one point; fields of several values keep their first name only."""
    names, sizes, kinds = (header.get(key, []) for key in ("FIELDS", "SIZE", "TYPE"))
    counts = header.get("COUNT", ["1"] * len(names))
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise ValueError("FIELDS, SIZE, TYPE and COUNT differ in length")
    layout: dict[str, tuple[str, tuple[int, ...]]] = {}
    for n, (name, size, kind, count) in enumerate(zip(names, sizes, kinds, counts, strict=True)):
        letter = _KINDS.get(kind, "")
        if not (size.isdigit() and count.isdigit() and int(size) in _SIZES.get(letter, ())):
            raise ValueError(f"field {name} has TYPE {kind}, SIZE {size}, COUNT {count}")
        if name in AXES and (letter != "f" or int(count) != 1):
            raise ValueError(f"field {name} must be one value of TYPE F")
        shape = () if int(count) == 1 else (int(count),)
        label = f"unnamed {n}" if name in layout or name == "_" or shape else name
        layout[label] = (f"<{letter}{size}", shape)
    if missing := [axis for axis in AXES if axis not in layout]:
        raise ValueError(f"no field {missing[0]}")
    record = np.dtype([(label, *of_field) for label, of_field in layout.items()])
    if record.itemsize > MAX_RECORD_BYTES:
        raise ValueError(f"a point takes {record.itemsize} bytes, limit {MAX_RECORD_BYTES}")
    return record


def _whole(header: Mapping[str, list[str]], key: str) -> int:
    words = header.get(key, [])
    if len(words) != 1 or not words[0].isdigit():
        raise ValueError(f"{key} must be one whole number")
    return int(words[0])


def _ascii_rows(body: bytes, record: np.dtype[np.void], points: int) -> npt.NDArray[np.void]:
    words = body.split()
    names = record.names or ()
    widths = [int(np.prod(record[name].shape, dtype=np.int64)) for name in names]
    if len(words) != points * sum(widths):
        raise ValueError(f"{len(words)} numbers for {points} points of {sum(widths)} each")
    numbers = np.array(words, np.float64).reshape(points, sum(widths))
    rows = np.zeros(points, record)
    first = 0
    for name, width in zip(names, widths, strict=True):
        if width == 1:
            rows[name] = numbers[:, first]
        first += width
    return rows


def _binary_rows(body: bytes, record: np.dtype[np.void], points: int) -> npt.NDArray[np.void]:
    if len(body) < points * record.itemsize:
        raise ValueError(f"{len(body)} bytes for {points} points of {record.itemsize} each")
    return np.frombuffer(body, record, points)


def _compressed_rows(body: bytes, record: np.dtype[np.void], points: int) -> npt.NDArray[np.void]:
    """Reads LZF over the fields one after the other."""
    if len(body) < 8:
        raise ValueError("the sizes of compressed data are missing")
    packed, unpacked = (int(n) for n in np.frombuffer(body, "<u4", 2))
    if unpacked != points * record.itemsize:
        raise ValueError(f"{unpacked} bytes for {points} points of {record.itemsize} each")
    if packed > len(body) - 8:
        raise ValueError(f"{packed} compressed bytes, {len(body) - 8} are there")
    raw = decompress(body[8 : 8 + packed], unpacked)
    rows = np.zeros(points, record)
    at = 0
    for name in record.names or ():
        field = record[name]
        plain = np.frombuffer(raw, field.base, points * (field.itemsize // field.base.itemsize), at)
        rows[name] = plain.reshape(points, *field.shape)
        at += points * field.itemsize
    return rows
