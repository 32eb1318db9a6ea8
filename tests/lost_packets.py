"""A loss pattern that is given, packet by packet, for tests of what TCP makes of it."""

from sensing.packet_loss import LossPattern


class LostPackets(LossPattern):
    """Loses the packets of these numbers."""

    def __init__(self, *lost: int) -> None:
        self._lost = frozenset(lost)

    def __getitem__(self, packet: int) -> bool:
        return packet in self._lost
