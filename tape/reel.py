"""One MCAP file as it is written: in small chunks, so that a kill costs little."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from mcap.writer import CompressionType, Writer

from protocol.errors import ConfigError, CpnetError
from protocol.version import own_version
from tape.names import CLOSING, FACTS, SETUP, SETUP_TYPE

CHUNK_BYTES = 256 << 10
CHUNK_NS = 700_000_000  # then a chunk is closed, however small it is
MAX_CHANNELS = 16_384  # a quarter of what the format allows
MAX_CHUNKS = 10_000  # the index of each stays in memory until the end
_NEVER_BYTES = 1 << 62


class Reel:
    """Takes messages; what is older than a second is in the file, if `settle` is called often."""

    def __init__(self, path: Path, setup: bytes, facts: dict[str, str]) -> None:
        """Begins a file with what is known of the run, and its setup.

        Raises:
            ConfigError: the file is there already or cannot be written.
        """
        self.path = path
        self._counts: dict[int, int] = {}
        self._log_ns = 0
        self._began_ns = 0
        self._waiting_bytes = 0
        self._chunks = 0
        self._is_closed = False
        self.size_bytes = 0
        try:
            self._file = path.open("xb")
        except OSError as error:
            raise ConfigError(f"{path} cannot be written: {error.strerror or error}") from None
        # Chunks end here and not in the library, so that each is in the file as soon as it ends.
        self._writer = Writer(self._file, _NEVER_BYTES, CompressionType.ZSTD)
        with self._named_faults():
            self._writer.start(library=f"cpnet {own_version()}")
            self._writer.add_metadata(FACTS, facts)
            self._writer.add_attachment(0, 0, SETUP, SETUP_TYPE, setup)
            self._writer.flush()

    @property
    def is_full(self) -> bool:
        """Whether another file should go on, before the index of this one takes too much memory."""
        return len(self._counts) >= MAX_CHANNELS or self._chunks >= MAX_CHUNKS

    def schema(self, name: str, encoding: str, data: bytes) -> int:
        """Returns the number of a new schema."""
        number: int = self._writer.register_schema(name, encoding, data)
        return number

    def channel(self, topic: str, encoding: str, schema: int, facts: dict[str, str]) -> int:
        """Returns the number of a new channel."""
        number: int = self._writer.register_channel(topic, encoding, schema, facts)
        self._counts[number] = 0
        return number

    def write(self, channel: int, data: bytes, log_ns: int, sim_time_ns: int | None) -> None:
        """Adds a message; its log time is never before that of an earlier one.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        self._log_ns = max(self._log_ns, log_ns)
        if not self._waiting_bytes:
            self._began_ns = self._log_ns
        count = self._counts[channel]
        self._counts[channel] = (count + 1) & 0xFFFFFFFF
        published_ns = self._log_ns if sim_time_ns is None or sim_time_ns < 0 else sim_time_ns
        self._writer.add_message(channel, self._log_ns, data, published_ns, count)
        self._waiting_bytes += len(data)
        if self._waiting_bytes >= CHUNK_BYTES:
            self._end_chunk()

    def settle(self, now_ns: int) -> None:
        """Ends the chunk if it is old.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        if self._waiting_bytes and now_ns - self._began_ns >= CHUNK_NS:
            self._end_chunk()

    def close(self, facts: dict[str, str]) -> None:
        """Writes what came of it, the index and the end, unless that was done or the disk failed.

        Raises:
            CpnetError: the disk is full, or fails.
        """
        if self._is_closed:
            return
        self._is_closed = True
        with self._named_faults():
            self._writer.flush()
            self._writer.add_metadata(CLOSING, facts)
            self._writer.finish()
            self.size_bytes = self._file.tell()
            self._file.close()

    def _end_chunk(self) -> None:
        self._waiting_bytes = 0
        self._chunks += 1
        with self._named_faults():
            self._writer.flush()
        self.size_bytes = self._file.tell()

    @contextlib.contextmanager
    def _named_faults(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._is_closed = True
            with contextlib.suppress(OSError):
                self._file.close()
            raise CpnetError(f"{self.path} cannot be written: {error.strerror or error}") from None
