"""LZF, the compression within .pcd files. Source: Lehmann's liblzf, `lzf_d.c`."""

from __future__ import annotations


def decompress(data: bytes, size: int) -> bytes:
    """Returns the `size` bytes that were compressed; never more are written.

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
    piece = bytes(out[start : start + length])
    turns = -(-length // len(piece))  # what is there is one period, if it is too short
    out += (piece * turns)[:length]
