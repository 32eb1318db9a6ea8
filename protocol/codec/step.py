"""From a bound on the error to a step of quantisation."""

from __future__ import annotations

import math

from protocol.errors import CodecError

MIN_BOUND_M, MAX_BOUND_M = 1e-4, 10.0
_ROUNDING = 2.0**-22  # of a distance: what float32 may do to a point on both sides


def check_bound(max_error_m: float) -> None:
    """Refuses a bound that makes no sense.

    Raises:
        CodecError: it is not a length between 0.1 mm and 10 m.
    """
    if not (math.isfinite(max_error_m) and MIN_BOUND_M * (1 - 1e-6) <= max_error_m <= MAX_BOUND_M):
        raise CodecError(f"error bound {max_error_m} m: needs {MIN_BOUND_M} to {MAX_BOUND_M:g}")


def room_m(max_error_m: float, farthest_m: float, kind: str) -> float:
    """Returns what quantisation may use of the bound: all but what float32 takes.

    Args:
        max_error_m: the bound.
        farthest_m: the largest distance or coordinate.
        kind: what it is, for the message.

    Raises:
        CodecError: float32 alone takes half of the bound.
    """
    room = max_error_m - (farthest_m + max_error_m) * _ROUNDING
    if room < max_error_m / 2:
        raise CodecError(
            f"{kind} {farthest_m:.1f} m at a bound of {max_error_m} m: float32 ends at "
            f"{max_error_m / 2 / _ROUNDING:.1f} m"
        )
    return room
