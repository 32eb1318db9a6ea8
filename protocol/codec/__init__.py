"""Scan codec: compression of LiDAR scans and point clouds within a given error bound.

Profiles trade time for bytes (`Profile`); the bound is chosen apart from them and holds for the
distance between each point and its decoded self. A form that could not keep it refuses the scan.
The decoder checks what a payload claims before it allocates; a damaged one raises `CodecError`.

`forms`             encoding and decoding, by form
`payload`           prefix, sections, zstd, intensities
`planes`            profile fast: differences as byte planes
`image_sections`    profile default: a range image as sections, and the window that is not empty
`range_image`       the loops over its beams: ranges to symbols, symbols to points
`prediction`        the model: expected ranges, contexts
`rings`             range images of unordered clouds of one spinning LiDAR
`octree`            clouds of any kind: cells and the points in them
`lattice`           where an octree's points may lie, and their order
`tree_contexts`     contexts of its symbols
`symbols`, `rans`   tables of shares and streams of symbols; tokens and the entropy coder
"""

from protocol.codec.forms import decode, encode_cloud, encode_scan
from protocol.codec.payload import claimed_points

__all__ = [
    "claimed_points",
    "decode",
    "encode_cloud",
    "encode_scan",
]
