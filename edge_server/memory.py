"""What becomes of memory that a frame no longer needs."""

from __future__ import annotations

import ctypes

# Of malloc.h: the free memory on top of the heap that goes back to the kernel, the size of what
# gets pages of its own, and how many heaps there may be.
_TRIM_THRESHOLD, _MMAP_THRESHOLD, _ARENA_MAX = -1, -3, -8
_LARGEST_BYTES = 32 << 20  # glibc takes no more
_KEPT_BYTES = 512 << 20


def keep_freed_memory() -> None:
    """Has the process keep what it frees, for the next frame, whichever thread works on it.

    A frame's arrays are large enough for glibc to give them back each time; to be given the same
    pages anew, zeroed, can take a fourth of a frame's time. Other C libraries are left as they are.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGEST_BYTES)
        mallopt(_TRIM_THRESHOLD, _KEPT_BYTES)
        mallopt(_ARENA_MAX, 1)
