"""Scans as bytes: what a LiDAR returned, within a named error bound.

Profiles trade time for bytes (`Profile`); the bound is chosen apart from them and holds for the
distance between each point and its decoded self. A form that could not keep it refuses the scan.
The decoder checks what a payload claims before it allocates; a damaged one raises `CodecError`.
"""

from protocol.codec.decode import decode
from protocol.codec.encode import encode_cloud, encode_scan
from protocol.codec.payload import claimed_points

__all__ = [
    "claimed_points",
    "decode",
    "encode_cloud",
    "encode_scan",
]
