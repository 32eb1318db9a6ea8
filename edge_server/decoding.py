"""Decoder pool: threads decode and place chunks on all cores, while others are received."""

from __future__ import annotations

import ctypes
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

from edge_server.frame import Chunk
from perception.parallel import threads
from protocol.codec import claimed_points
from protocol.limits import MAX_POINTS
from protocol.messages import Scan

PER_THREAD = 2  # chunks: one that it decodes, one that is next


# Of malloc.h: the free memory on top of the heap that goes back to the kernel, the size of what
# gets pages of its own, and how many heaps there may be.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_LARGEST_BYTES = 32 << 20  # glibc takes no more
_KEPT_BYTES = 512 << 20


def keep_freed_memory() -> None:
    """Makes glibc keep freed memory in the process, for the next frame, in any thread.

    A frame's arrays are large enough for glibc to give them back each time; to get the same pages
    again, zeroed, can take a fourth of a frame's time. Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_ARENA_MAX, 1)


@dataclass(frozen=True, slots=True, eq=False)
class PendingChunk:
    """A chunk that is being decoded or was, and when it arrived."""

    scan: Scan
    received_ns: int
    points: int
    future: Future[Chunk]

    def chunk(self) -> Chunk:
        """Waits until the chunk is decoded; raises the decoder's error."""
        return self.future.result()


class DecoderPool:
    """Decodes chunks in threads of its own and returns them in the order of their arrival.

    It is for the use of one thread; its threads call `open_scan`, and `wake` once a chunk is
    decoded. What is pending is bounded: two chunks a thread, and all together claim no more points
    than one alone may. `put` waits beyond that; meanwhile scans wait in the inbox, which decides by
    its limits what is dropped.
    """

    def __init__(
        self, open_scan: Callable[[Scan, int], Chunk], wake: Callable[[], None] = lambda: None
    ) -> None:
        self._open_scan = open_scan
        self._wake = wake
        self._most = PER_THREAD * threads()
        alone = threads() == 1
        self._pool = _CallerThread() if alone else ThreadPoolExecutor(threads(), "decode")
        self._under_way: deque[PendingChunk] = deque()

    def __len__(self) -> int:
        return len(self._under_way)

    def put(self, scan: Scan, received_ns: int) -> list[PendingChunk]:
        """Queues a scan for decoding; returns earlier ones that it had to wait for."""
        points = claimed_points(scan.payload)
        waited_for = []
        while not self._has_room(points):
            waited_for.append(self._take())
        future = self._pool.submit(self._open_scan, scan, received_ns)
        self._under_way.append(PendingChunk(scan, received_ns, points, future))
        future.add_done_callback(lambda _: self._wake())
        return waited_for

    def done(self) -> Iterator[PendingChunk]:
        """Yields decoded chunks, up to the first that is not."""
        while self._under_way and self._under_way[0].future.done():
            yield self._under_way.popleft()

    def rest(self) -> Iterator[PendingChunk]:
        """Yields all pending chunks, as soon as they are decoded."""
        while self._under_way:
            yield self._take()

    def close(self) -> None:
        """Cancels what no thread has begun with, and ends the threads."""
        self._under_way.clear()
        self._pool.shutdown(cancel_futures=True)

    def _has_room(self, points: int) -> bool:
        claimed = points + sum(other.points for other in self._under_way)
        return not self._under_way or (len(self._under_way) < self._most and claimed <= MAX_POINTS)

    def _take(self) -> PendingChunk:
        pending = self._under_way.popleft()
        pending.future.exception()
        return pending


class _CallerThread(Executor):
    """Runs each task in the calling thread: with one core, others would only slow it down."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ANN401 - as an Executor has it
        """Returns a future that is done."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:  # noqa: BLE001 - raised to the caller by `result`
            future.set_exception(error)
        return future
