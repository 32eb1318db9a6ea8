"""Who is connected: drawn once per vehicle, by the seed and its id alone."""

from __future__ import annotations

import zlib

import numpy as np

from protocol.messages import Equipment


def draw_equipment(seed: int, vehicle: str, cav_rate: float, cv_rate: float) -> Equipment:
    """Returns what a vehicle carries.

    One uniform number decides, so a higher rate keeps every CAV that a lower rate had.
    """
    sequence = np.random.SeedSequence([seed, zlib.crc32(vehicle.encode())])
    uniform = int(sequence.generate_state(1)[0]) / 2**32
    if uniform < cav_rate:
        return Equipment.CAV
    return Equipment.CV if uniform < cav_rate + cv_rate else Equipment.NONE
