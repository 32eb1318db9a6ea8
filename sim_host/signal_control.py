"""The control of one signal: its cabinet, and the requests that wait for it."""

from __future__ import annotations

import logging
import time
from collections import Counter
from dataclasses import dataclass

from protocol.inbox import Envelope
from protocol.messages import SignalRequest, SignalState, Span
from sim_host.cabinet import Cabinet, PendingRequest, PendingRequests

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Actuation:
    """A request on which a cabinet acted, and how long that took since its arrival."""

    request: SignalRequest
    span: Span


class SignalControl:
    """Receives requests for one signal and acts on them; refuses what its cabinet would refuse.

    In lockstep the first request that answers the present frame is kept until the frame ends, in
    realtime each waits until it is due. `out_of_turn` counts those that answer another frame.
    """

    def __init__(self, tls: str, cabinet: Cabinet, *, lockstep: bool) -> None:
        self.tls = tls
        self.cabinet = cabinet
        self._lockstep = lockstep
        self._answer: Envelope | None = None
        self._pending = PendingRequests()
        self.out_of_turn = 0

    @property
    def has_answer(self) -> bool:
        """Whether the present frame was answered; in lockstep."""
        return self._answer is not None

    @property
    def advised(self) -> int:
        """How much speed advice belongs to the answer; in lockstep."""
        answer = self._answer.message if self._answer is not None else None
        return answer.advised if isinstance(answer, SignalRequest) else 0

    def spat(self, frame: int, now_ns: int) -> SignalState:
        """Begins a frame; returns phase and timing."""
        self._answer = None
        return self.cabinet.spat(frame, now_ns)

    def take(self, item: Envelope, request: SignalRequest, now_ns: int, *, awaited: bool) -> None:
        """Receives a request; in lockstep only the first one that is `awaited`."""
        if self._lockstep and (self._answer is not None or not awaited):
            self.out_of_turn += 1
        elif self._is_refused(request, self.cabinet.refuse(request, now_ns)):
            return
        elif self._lockstep:
            self._answer = item
        else:
            self._pending.add(item, request)

    def end_frame(self) -> None:
        """Makes the frame's answer a request that waits until it is due."""
        if self._answer is not None and isinstance(self._answer.message, SignalRequest):
            self._pending.add(self._answer, self._answer.message)

    def actuate(self, now_ns: int) -> Actuation | None:
        """Hands the request that is due to the cabinet, if one is.

        The span belongs to the frame that the request answers: in realtime and with virtual links
        that is often an older one.
        """
        due: PendingRequest | None = self._pending.take(
            now_ns, lambda one: not self._is_refused(one, self.cabinet.request(one, now_ns))
        )
        if due is None:
            return None
        request = due.request
        since_ns = time.monotonic_ns() if request.delay_sim_ns else due.envelope.received_ns
        self.cabinet.advance(now_ns)
        span = Span(stage="actuate", agent=self.tls, start_ns=since_ns, end_ns=time.monotonic_ns())
        return Actuation(request, span)

    def drops(self) -> Counter[str]:
        """Returns by reason how many requests had no effect."""
        found = Counter({f"request_{why}": n for why, n in self.cabinet.refusals.items()})
        found["request_out_of_turn"] = self.out_of_turn
        found["request_overtaken"] = self._pending.overtaken
        found["request_crowded_out"] = self._pending.crowded_out
        return found

    def _is_refused(self, request: SignalRequest, reason: str | None) -> bool:
        if reason is not None and self.cabinet.refusals[reason] == 1:
            _log.warning("request %r refused: %s (then only counted)", request.state, reason)
        return reason is not None
