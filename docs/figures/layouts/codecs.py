"""The codec of scans beside others."""

from __future__ import annotations

from statistics import mean
from typing import Any

from layouts.tables import Rows, Table, fixed


def codec_kinds(rows: Rows) -> Table:
    """Returns bits a point and the share of Draco's bytes by kind of sensor, and speeds."""
    bounds = sorted({row["bound_m"] for row in rows if row["codec"] == "draco"})
    heads = [f"{100 * bound:g} cm, bits / of Draco" for bound in bounds]
    table = [["cloud", "points", *heads, "encode x Draco", "decode x Draco"]]
    for kind in ("simulated", "file"):
        own = [row for row in rows if row["kind"] == kind]
        for cloud in dict.fromkeys(row["cloud"] for row in own):
            pairs = [_beside_draco(own, cloud, bound, "default") for bound in bounds]
            cells = [
                f"{fixed(row['bits_per_point'], 2)} / {fixed(row['bytes'] / draco['bytes'], 2)}"
                for row, draco in pairs
            ]
            table.append([cloud, str(pairs[0][0]["points"]), *cells, *_speeds(pairs)])
    return table


def codec_extremes(rows: Rows) -> str:
    """Returns in a sentence the extremes of what is in the table of kinds."""
    pairs = [
        _beside_draco(rows, row["cloud"], row["bound_m"], "default")
        for row in rows
        if row["codec"] == "draco" and row["kind"] in ("simulated", "file")
    ]
    shares = sorted(row["bytes"] / draco["bytes"] for row, draco in pairs)
    encode, decode = (
        min(draco[step] / row[step] for row, draco in pairs) for step in ("encode_ms", "decode_ms")
    )
    return (
        f"In {len(pairs)} cells a cloud takes {fixed(shares[0], 2)} to {fixed(shares[-1], 2)} of "
        f"Draco's bytes; encoding is {fixed(encode, 2)} times as fast or faster, decoding "
        f"{fixed(decode, 2)} times."
    )


def _beside_draco(
    rows: Rows, cloud: str, bound_m: float, codec: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Returns the row of a codec and Draco's."""
    same = {r["codec"]: r for r in rows if r["cloud"] == cloud and r["bound_m"] == bound_m}
    return same[codec], same["draco"]


def _speeds(pairs: list[tuple[dict[str, Any], dict[str, Any]]]) -> list[str]:
    """Returns the least and the largest speed of encoding and decoding beside Draco's."""
    cells = []
    for step in ("encode_ms", "decode_ms"):
        ratios = [draco[step] / row[step] for row, draco in pairs]
        cells.append(f"{fixed(min(ratios), 1)} to {fixed(max(ratios), 1)}")
    return cells


_CODECS = {
    "default": "`default`", "fast": "`fast`", "draco": "Draco", "jpeg-xl": "JPEG XL, mask",
    "jpeg-ls": "JPEG-LS, mask",
}  # fmt: skip


def codec_scans(rows: Rows) -> Table:
    """Returns bits a point of structured scans by codec, means over the scans."""
    own = [row for row in rows if row["kind"] == "structured"]
    clouds = list(dict.fromkeys(row["cloud"] for row in own))
    bounds = sorted({row["bound_m"] for row in own if row["codec"] == "draco"})
    table = [["codec", *(f"{100 * bound:g} cm" for bound in bounds), "encode x Draco",
              "decode x Draco"]]  # fmt: skip
    for codec, name in _CODECS.items():
        if not any(row["codec"] == codec for row in own):
            continue
        pairs = [_beside_draco(own, cloud, bound, codec) for bound in bounds for cloud in clouds]
        bits = [
            fixed(mean(row["bits_per_point"] for row, _ in pairs if row["bound_m"] == bound), 2)
            for bound in bounds
        ]
        table.append([name, *bits, *_speeds(pairs)])
    return table


def codec_floor(rows: Rows) -> Table:
    """Returns bits a point beside the noise that they must hold."""
    table = [["cloud", "`default` bits/point", "x noise", "x noise and losses"]]
    for row in rows:
        noise = row["noise_floor_bits"]
        if noise and row["codec"] == "default" and row["bound_m"] == 0.01:
            both, bits = noise + (row["loss_floor_bits"] or 0), row["bits_per_point"]
            table.append(
                [row["cloud"], fixed(bits, 2), fixed(bits / noise, 2), fixed(bits / both, 2)]
            )
    return table
