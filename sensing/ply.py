"""Reader of the vertices of Stanford's .ply files: text, or binary in either byte order."""

from __future__ import annotations

import numpy as np

from sensing.limits import MAX_RECORD_BYTES
from sensing.pcd import AXES, Columns

_MOST_HEADER = 1 << 16
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
_SHADES = ("intensity", "scalar_intensity", "reflectance", "reflectivity")
_NEEDED = "format, element vertex N, and property float x, y, z"


def read_ply(data: bytes) -> Columns:
    """Reads a file's bytes; what follows the vertices is left.

    Raises:
        ValueError: they do not match their header, or have none.
    """
    order, count, record, body = _header(data)
    if order == "=":
        words = body.split(None, count * len(record))[: count * len(record)]
        if len(words) < count * len(record):
            raise ValueError(f"{len(words)} numbers for {count} vertices of {len(record)} each")
        rows = dict(zip(record, np.array(words, np.float64).reshape(count, -1).T, strict=True))
    else:
        layout = np.dtype([(name, order + kind) for name, kind in record.items()])
        if len(body) < count * layout.itemsize:
            raise ValueError(f"{len(body)} bytes for {count} vertices of {layout.itemsize} each")
        table = np.frombuffer(body, layout, count)
        rows = {name: table[name].astype(np.float64) for name in record}
    shade = next((rows[name] for name in _SHADES if name in rows), None)
    columns = {axis: rows[axis] for axis in AXES}
    return columns if shade is None else columns | {"intensity": shade}


def _header(data: bytes) -> tuple[str, int, dict[str, str], bytes]:
    """Returns the order of bytes, the number of vertices, their properties, and what follows."""
    end = data.find(b"end_header", 0, _MOST_HEADER)
    line = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line < 0:
        raise ValueError("no header of a .ply, which begins with ply and ends with end_header")
    order, count, record = "", -1, dict[str, str]()
    element = ""
    for words in (text.split() for text in data[:end].decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1], "")
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            if not element and words[1] != "vertex":
                raise ValueError(f"the element {words[1]:.40} stands before the vertices")
            element = words[1]
            count = int(words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES or words[2].lower() in record:
                raise ValueError(f"{' '.join(words)!r:.60} is no property of one number")
            record[words[2].lower()] = _TYPES[words[1]]
    if not order or count < 0 or any(axis not in record for axis in AXES):
        raise ValueError(f"its header lacks something of {_NEEDED}")
    if len(record) * 8 > MAX_RECORD_BYTES:
        raise ValueError(f"a vertex has {len(record)} properties, limit {MAX_RECORD_BYTES // 8}")
    return order, count, record, data[line + 1 :]
