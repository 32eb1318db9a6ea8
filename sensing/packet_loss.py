"""Which packets of a link are lost: independently or in bursts, after Gilbert and Elliott."""

from __future__ import annotations

from functools import cached_property

from sensing.link_profile import PacketLoss
from sensing.noise import stream

_BLOCK = 4096  # packets; each block begins anew in a state drawn by its share of time


class LossPattern:
    """Which packets, by number, are lost; drawn by seed and agent."""

    def __init__(self, loss: PacketLoss, seed: int, agent: str) -> None:
        self._loss = loss
        self._seed = seed
        self._agent = agent
        self._blocks: dict[int, bytes] = {}

    def __getitem__(self, packet: int) -> bool:
        """Whether the packet of this number, from 0, is lost."""
        number, place = divmod(packet, _BLOCK)
        if number not in self._blocks:
            self._blocks.pop(number - 2, None)  # a prediction is never further ahead
            self._blocks[number] = self._draw(number)
        return bool(self._blocks[number][place])

    def _draw(self, number: int) -> bytes:
        loss = self._loss
        rng = stream(self._seed, "packet loss", self._agent, number)
        is_bad = bool(rng.random() < self._bad_share)
        lost = bytearray(_BLOCK)
        for packet, (fate, change) in enumerate(rng.random((_BLOCK, 2)).tolist()):
            lost[packet] = fate < (loss.loss_in_bad if is_bad else loss.loss_in_good)
            is_bad = change >= loss.bad_to_good if is_bad else change < loss.good_to_bad
        return bytes(lost)

    @cached_property
    def _bad_share(self) -> float:
        return self._loss.good_to_bad / (self._loss.good_to_bad + self._loss.bad_to_good)
