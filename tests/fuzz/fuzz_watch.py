"""State of a fuzzing worker in a shared file, which outlives its process."""

from __future__ import annotations

import mmap
import struct
import time
from pathlib import Path
from typing import Self

MAX_BYTES = 1 << 18  # of an input
_BUCKETS = 400
_OCTAVE = 8  # buckets of time
_HEAD = struct.Struct("<QQQQI")  # inputs, begun at ns, slowest ns, most KiB, length
_TIMES = struct.Struct(f"<{_BUCKETS}I")
_ONE = struct.Struct("<I")
_SIZE = _HEAD.size + _TIMES.size + MAX_BYTES


class Watch:
    """A file in memory that outlives the process: the input at work, and how all were.

    `begun_ns` is 0 while no input is at work; the times are of CPU.
    """

    def __init__(self, path: Path, *, new: bool = False) -> None:
        if new:
            path.write_bytes(bytes(_SIZE))
        with path.open("r+b") as file:
            self._memory = mmap.mmap(file.fileno(), _SIZE)
        self.read()

    def read(self) -> Self:
        """Reads what the worker wrote."""
        self.inputs, self.begun_ns, self.slowest_ns, self.most_kib, self._length = (
            _HEAD.unpack_from(self._memory)
        )
        return self

    @property
    def input(self) -> bytes:
        """The input at work, or the last one."""
        start = _HEAD.size + _TIMES.size
        return self._memory[start : start + self._length]

    def begin(self, data: bytes) -> None:
        """Notes an input before it is read."""
        self.inputs += 1
        self._length = min(len(data), MAX_BYTES)
        start = _HEAD.size + _TIMES.size
        self._memory[start : start + self._length] = data[:MAX_BYTES]
        self.begun_ns = time.monotonic_ns()
        self._write()

    def end(self, took_ns: int) -> None:
        """Notes how long it took."""
        self.slowest_ns = max(self.slowest_ns, took_ns)
        at = _HEAD.size + 4 * _bucket(took_ns)
        _ONE.pack_into(self._memory, at, _ONE.unpack_from(self._memory, at)[0] + 1)
        self.begun_ns = 0
        self._write()

    def note_memory(self, kib: int) -> None:
        """Notes how much more memory the process ever had than when it began."""
        self.most_kib = max(self.most_kib, kib)
        self._write()

    def quantile_ms(self, share: float) -> float:
        """Returns the time that so many of the inputs stayed below, to an eighth of an octave."""
        counts = _TIMES.unpack_from(self._memory, _HEAD.size)
        left = share * sum(counts)
        for bucket, count in enumerate(counts):
            left -= count
            if left <= 0:
                return float(2 ** ((bucket + 1) / _OCTAVE) / 1e6)
        return 0.0

    def _write(self) -> None:
        _HEAD.pack_into(
            self._memory,
            0,
            self.inputs,
            self.begun_ns,
            self.slowest_ns,
            self.most_kib,
            self._length,
        )


def _bucket(took_ns: int) -> int:
    octave = max(took_ns, 1).bit_length() - 1
    eighth = (took_ns << 3 >> octave) & 7 if octave else 0
    return min(_OCTAVE * octave + eighth, _BUCKETS - 1)


def peak_kib() -> int:
    """Returns the most memory that this process ever had."""
    return _status("VmHWM")


def virtual_kib() -> int:
    """Returns the addresses that this process has."""
    return _status("VmSize")


def forget_peak() -> None:
    """Has the peak begin anew with what the process has now (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


def _status(name: str) -> int:
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(name):
            return int(line.split()[1])
    raise LookupError(name)
