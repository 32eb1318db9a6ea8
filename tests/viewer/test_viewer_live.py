"""The live viewer draws the frames that it has time for, and the last frame in any case."""

import threading

from protocol import messages as m
from protocol.inbox import Inbox, Presence, RawMessage
from protocol.topics import TOPICS, BusName
from protocol.wire import encode
from tests.messages import lane_counts
from tests.viewer.shown import SETUP
from viewer.live import Live
from viewer.scene import Picture, Scene
from viewer.stages import FrameLatency

FRAMES = 20


class Drawn:
    """Records which frames are drawn."""

    def __init__(self) -> None:
        self.frames: list[int] = []

    def picture(self, picture: Picture) -> None:
        self.frames.append(picture.frame)

    def latency(self, latency: FrameLatency) -> None:
        raise AssertionError(latency)


def sealed(topic: str, key: str, message: m.Message) -> RawMessage:
    return RawMessage(TOPICS[topic], key, encode(message), 0)


def test_a_lost_v2x_bus_is_not_the_end_and_a_lost_world_is() -> None:
    for bus, is_over in ((BusName.V2X, False), (BusName.WORLD, True)):
        inbox, stop = Inbox(), threading.Event()
        live = Live(inbox, Scene(SETUP), Drawn(), 1e9)
        inbox.put(Presence("sim", "sim", alive=False, bus=bus))
        threading.Timer(0.3, stop.set).start()
        live.follow(stop)
        assert live.is_over == is_over


def frames_drawn(fps: float) -> list[int]:
    """Returns what is drawn of a run that ended before the viewer attached."""
    inbox = Inbox()
    for frame in range(FRAMES):
        inbox.put(sealed("lanes", TOPICS["lanes"].key(region="r0", tls="J"), lane_counts(frame)))
    inbox.put(sealed("end", TOPICS["end"].key(), m.End(reason="finished", frames=FRAMES)))
    shows = Drawn()
    live = Live(inbox, Scene(SETUP), shows, fps)
    live.follow(threading.Event())
    assert not inbox.drops
    assert live.left_out == FRAMES - len(shows.frames)
    return shows.frames


def test_every_frame_is_drawn_below_the_frame_rate() -> None:
    assert frames_drawn(1e9) == [*range(FRAMES)]


def test_beyond_the_frame_rate_only_the_first_and_the_last_frame_are_drawn() -> None:
    assert frames_drawn(1e-3) == [0, FRAMES - 1]
