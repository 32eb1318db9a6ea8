"""Random streams by purpose: independent of the order in which they are drawn."""

from __future__ import annotations

import hashlib

import numpy as np


def stream(seed: int, *keys: str | int) -> np.random.Generator:
    """Returns the generator of (seed, keys), such as `stream(seed, "scan", agent, frame)`.

    The same on every machine and in every process; two different lists of keys share nothing.
    SFC64, the fastest of NumPy's bit generators.
    """
    text = repr((seed, keys)).encode()
    digest = hashlib.blake2b(text, digest_size=16).digest()
    entropy = int.from_bytes(digest, "little")
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(entropy)))
