"""The sim role: waits for the other processes, warms traffic up, then runs frame after frame."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Iterable, Mapping
from enum import Enum
from functools import partial
from pathlib import Path

from protocol.errors import BusError, CpnetError
from protocol.inbox import Envelope, Presence
from protocol.instances import WORLD_HOST, instances_of
from protocol.limits import MAX_ITEMS
from protocol.messages import (
    End,
    Metrics,
    Setup,
    SignalRequest,
    Span,
    SpeedAdvice,
    TileRequest,
    Trips,
)
from protocol.process import Context
from protocol.topics import BusName
from sensing.config import SceneConfig
from sensing.recorded_scans import Recording
from sensing.terrain import Terrain
from sim_host.advised_speeds import AdvisedSpeeds, SpeedBounds
from sim_host.cabinet import ActuatedCabinet, Cabinet, SignalCabinet, loop_parameters, programme
from sim_host.config import CabinetConfig
from sim_host.presence import Fleet, Readiness
from sim_host.setup import traffic_config
from sim_host.signal_control import SignalControl
from sim_host.ticks import TickPublisher
from sim_host.world import RecordedWorld, Traffic, World, truth_of


class FrameClock:
    """When the next frame is due in realtime, in monotonic ns; a world that is late slips."""

    def __init__(self, period_ns: int) -> None:
        self._period_ns = period_ns
        self._due_ns: int | None = None
        self.late = 0

    def wait_ns(self, now_ns: int) -> int:
        """Returns how long to wait for the next frame, 0 if it is due."""
        return 0 if self._due_ns is None else max(0, self._due_ns - now_ns)

    def begin_frame(self, now_ns: int) -> None:
        """Notes that a frame begins now; one that is a whole period late shifts all that follow."""
        due_ns = now_ns if self._due_ns is None else self._due_ns
        if now_ns - due_ns >= self._period_ns:
            self.late += 1
            due_ns = now_ns
        self._due_ns = due_ns + self._period_ns


_WARM_UP_SLICE_NS = 50_000_000  # longest that warm-up delays a stop
_SHORT_WAIT_NS = 30_000_000  # more than the loop's own pause, so that it delays no tick
_RECORDER_RESTART_NS = 5_000_000_000  # for a recorder that failed to restart
_RECORDER_EXIT_NS = 2_000_000_000  # for the recorder to write the last messages
_log = logging.getLogger(__name__)


class Stage(Enum):
    """Stages of a run."""

    READINESS = "readiness"
    WARM_UP = "warm-up"
    IDLE = "idle"
    FRAME = "frame"
    LAST = "last"
    OVER = "over"


class SimRole:
    """Owns the world, the signals' cabinets and the clock.

    IDLE lies between frames: a tick follows. FRAME waits for what ends the frame: in lockstep a
    request for each signal, on which the cabinets then act; in realtime the clock, while requests
    act as they arrive. The signal state of a tick is what was shown until then.

    What a cabinet would refuse is refused on arrival: it is neither pending nor ends a frame.
    """

    def __init__(
        self,
        context: Context,
        world: Traffic,
        cabinets: Mapping[str, Cabinet] | None = None,
        *,
        advised: AdvisedSpeeds | None = None,
        first_frame: int = 0,
        speed: float = 1.0,
    ) -> None:
        """Begins with `first_frame`; in realtime, `speed` is simulated over wall time.

        With `advised`, vehicles follow speed advice.
        """
        scenario = context.setup.scenario
        self._context = context
        self._world = world
        self._traffic = traffic_config(scenario)
        self._cabinet_config = CabinetConfig.model_validate(scenario["cabinet"])
        self._fleet = Fleet()
        self._ticking = TickPublisher(context.world, context.setup)
        others = [one.id for one in instances_of(scenario) if one.role != WORLD_HOST]
        self._readiness = Readiness(others, self._traffic.start_timeout_s)
        self._lockstep = scenario["mode"] == "lockstep"
        self._controls = {
            one.tls: SignalControl(
                one.tls,
                cabinets[one.tls] if cabinets else SignalCabinet(one.signal, self._cabinet_config),
                lockstep=self._lockstep,
            )
            for one in context.setup.road_map.intersections
        }
        self._advised = advised
        self._unknown_signal = 0
        frames = max(1, round(scenario["duration_s"] / scenario["frame_period_s"]))
        self._end_frame = first_frame + frames
        self._steps = max(1, round(scenario["frame_period_s"] / self._traffic.step_s))
        self._clock = FrameClock(round(scenario["frame_period_s"] * 1e9 / speed))
        self._stage = Stage.READINESS
        self._since_ns = 0
        self._warm_ns = world.time_ns + round(self._traffic.warmup_s * 1e9)
        self._frame = first_frame
        self._tick_ns = 0
        self._ticks = 0

    @classmethod
    def build(cls, context: Context) -> SimRole:
        """Starts SUMO and announces the role.

        Raises:
            ConfigError: SUMO cannot be started with this scenario.
        """
        setup = context.setup
        scene = SceneConfig.model_validate(setup.scenario["scene"])
        seed: int = setup.scenario["seed"]
        recording = setup.scenario.get("recording")
        world: Traffic
        cabinets = advised = None
        if recording:
            step_ns = round(traffic_config(setup.scenario).step_s * 1e9)
            world = RecordedWorld(Recording(Path(recording)), step_ns)
        else:
            world = World(setup, context.run_dir, Terrain(setup.road_map, scene, seed))
            world.start(seed)
            cabinets, advised = _sumo_control(setup, world), _speed_advice(setup, world)
        return cls(context, world, cabinets, advised=advised).open()

    def open(self) -> SimRole:
        """Subscribes to requests, advice and queries, and announces the role."""
        self._context.v2x.subscribe("request")
        if self._advised is not None:
            self._context.v2x.subscribe("advice")
        self._context.world.subscribe("tiles")
        self._context.world.watch()
        self._context.v2x.watch()
        self._context.announce("sim")
        return self

    def on(self, item: Envelope | Presence) -> None:
        """Handles a presence or a request; signals act at once in realtime, else at frame's end."""
        if isinstance(item, Presence):
            self._note_presence(item)
        elif isinstance(item.message, SignalRequest):
            self._take_request(item, item.message)
        elif isinstance(item.message, SpeedAdvice):
            self._take_advice(item, item.message)
        elif isinstance(item.message, TileRequest):
            self._ticking.answer(item.message)

    def poll(self) -> None:
        """Does what is due.

        Raises:
            BusError: a process or a request did not arrive in time.
            ConfigError: SUMO gave up.
        """
        try:
            self._advance()
        except CpnetError:
            self._end("failed")
            raise

    def _advance(self) -> None:
        if self._stage is Stage.READINESS and self._readiness.is_complete():
            _log.info("all processes are ready; %g s of warm-up", self._traffic.warmup_s)
            self._stage = Stage.WARM_UP
        if self._stage is Stage.WARM_UP:
            self._warm_up()
        if self._stage is Stage.FRAME and self._frame_is_over():
            self._finish_frame()
        if self._stage is Stage.LAST:
            self._await_recorder()
        if self._stage is Stage.IDLE:
            self._begin_frame()

    def close(self) -> None:
        """Ends the run, if it has not ended by itself, and waits for the recorder to exit."""
        try:
            if self._stage is not Stage.OVER:
                self._end("stopped")
            self._await_recorder_exit()
        finally:
            self._world.close()

    def _await_recorder_exit(self) -> None:
        """Waits until recording processes have exited: the world's router ends with this one."""
        until_ns = time.monotonic_ns() + _RECORDER_EXIT_NS
        while self._is_written() and time.monotonic_ns() < until_ns:
            item = self._context.inbox.get(_SHORT_WAIT_NS / 1e9)
            if isinstance(item, Presence):
                self._readiness.note(item)

    def _is_written(self) -> bool:
        return any(self._readiness.is_on(BusName.WORLD, name) for name in ("record", "mcap"))

    def _note_presence(self, presence: Presence) -> None:
        self._readiness.note(presence)
        if presence.role == "vehicle":
            (self._fleet.join if presence.alive else self._fleet.leave)(presence.id)

    def _take_request(self, item: Envelope, request: SignalRequest) -> None:
        control = self._controls.get(request.tls)
        if control is None:
            self._unknown_signal += 1
            return
        awaited = self._is_awaited(request)
        control.take(item, request, self._world.time_ns, awaited=awaited)
        if not self._lockstep:
            self._actuate([control])

    def _take_advice(self, item: Envelope, advice: SpeedAdvice) -> None:
        if self._advised is not None:
            awaited = self._is_awaited(advice)
            self._advised.take(advice, item.parts, self._world.time_ns, awaited=awaited)

    def _is_awaited(self, message: SignalRequest | SpeedAdvice) -> bool:
        """Whether a message answers the frame that has begun."""
        answers = (message.frame, message.sim_time_ns) == (self._frame, self._tick_ns)
        return answers and self._stage is Stage.FRAME

    def _warm_up(self) -> None:
        until_ns = time.monotonic_ns() + _WARM_UP_SLICE_NS
        while self._world.time_ns < self._warm_ns and time.monotonic_ns() < until_ns:
            self._step()
        if self._world.time_ns >= self._warm_ns:
            _log.info("%d vehicles inserted; frame %d", self._world.counts.inserted, self._frame)
            self._stage = Stage.IDLE

    def _begin_frame(self) -> None:
        frame, now_ns, bodies = self._frame, self._world.time_ns, self._world.bodies()
        self._tick_ns = now_ns
        self._since_ns = time.monotonic_ns()
        if not self._lockstep:
            self._clock.begin_frame(self._since_ns)
        self._stage = Stage.FRAME
        if self._advised is not None:
            self._advised.begin_frame()
        for tls, control in self._controls.items():
            self._context.v2x.publish("state", control.spat(frame, now_ns), tls=tls)
        self._ticking.publish(frame, now_ns, bodies, self._fleet)
        self._ticks += 1
        self._context.world.publish("truth", truth_of(frame, now_ns, bodies))

    def _frame_is_over(self) -> bool:
        now_ns = time.monotonic_ns()
        if not self._lockstep:
            return self._frame_time_is_over(now_ns)
        waited_ns = now_ns - self._since_ns
        missing = [one for one in self._controls.values() if not self._is_answered(one)]
        if missing and waited_ns > self._cabinet_config.request_timeout_s * 1e9:
            raise BusError(self._hang(missing))
        return not missing

    def _is_answered(self, control: SignalControl) -> bool:
        """Whether a signal's request has come, with the advice that belongs to it."""
        arrived = self._advised.arrived(control.tls) if self._advised else control.advised
        return control.has_answer and arrived >= control.advised

    def _hang(self, missing: list[SignalControl]) -> str:
        refusals = sum((Counter(one.cabinet.refusals) for one in missing), Counter[str]())
        refused = ", ".join(f"{n} {why}" for why, n in refusals.items())
        lacks = "complete speed advice" if all(one.has_answer for one in missing) else "request"
        return (
            f"no {lacks} for frame {self._frame} for {', '.join(one.tls for one in missing[:5])} "
            f"within cabinet.request_timeout_s, {self._cabinet_config.request_timeout_s:g} s: edge "
            "or signal hangs"
            + (f", or asks for what the cabinet refuses ({refused})" if refused else "")
        )

    def _frame_time_is_over(self, now_ns: int) -> bool:
        """Whether the frame's time is over; waits for its end, so that the tick is on time."""
        wait_ns = self._clock.wait_ns(now_ns)
        if wait_ns > _SHORT_WAIT_NS:
            return False
        while wait_ns > 0:
            item = self._context.inbox.get(wait_ns / 1e9)
            if item is not None:
                self.on(item)
            wait_ns = self._clock.wait_ns(time.monotonic_ns())
        return True

    def _finish_frame(self) -> None:
        for control in self._controls.values():
            control.end_frame()
        start_ns = time.monotonic_ns()
        for _ in range(self._steps):
            self._actuate(self._controls.values())
            if self._advised is not None:
                self._advised.actuate(self._world.time_ns)
            self._step()
        stepped = Span(stage="world", start_ns=start_ns, end_ns=time.monotonic_ns())
        self._publish_trips(with_unfinished=False)
        self._publish_metrics(self._frame, self._tick_ns, [stepped])
        self._frame += 1
        self._stage = Stage.IDLE
        if self._frame == self._end_frame:
            self._stage = Stage.LAST
            self._since_ns = time.monotonic_ns()

    def _await_recorder(self) -> None:
        """Ends the run once the recorder is present to receive the end: it may be restarting."""
        is_here = self._readiness.is_on(BusName.WORLD, "record")
        if is_here or time.monotonic_ns() - self._since_ns > _RECORDER_RESTART_NS:
            self._end("finished")

    def _actuate(self, controls: Iterable[SignalControl]) -> None:
        """Lets cabinets act on due requests; publishes metrics of each answered frame."""
        now_ns = self._world.time_ns
        spans: dict[tuple[int, int], list[Span]] = {}
        for control in controls:
            acted = control.actuate(now_ns)
            if acted is not None:
                answered = acted.request.frame, acted.request.sim_time_ns
                spans.setdefault(answered, []).append(acted.span)
        for (frame, sim_time_ns), found in sorted(spans.items()):
            self._publish_metrics(frame, sim_time_ns, found)

    def _step(self) -> None:
        for tls, control in self._controls.items():
            self._world.set_signal(tls, control.cabinet.advance(self._world.time_ns))
        self._world.step()

    def _publish_trips(self, *, with_unfinished: bool) -> None:
        trips = self._world.take_trips()
        if with_unfinished:
            trips += self._world.unfinished_trips()
        frame = min(self._frame, self._end_frame - 1)
        for first in range(0, len(trips), MAX_ITEMS):
            part = trips[first : first + MAX_ITEMS]
            self._context.world.publish("trips", Trips(frame=frame, trips=part))

    def _publish_metrics(self, frame: int, sim_time_ns: int, spans: list[Span]) -> None:
        message = Metrics(
            process=self._context.id,
            frame=frame,
            sim_time_ns=sim_time_ns,
            spans=spans,
            drops=self._drops(),
        )
        self._context.world.publish("metrics", message, process=self._context.id)

    def _drops(self) -> dict[str, int]:
        found = Counter(self._context.inbox.drops)
        for control in self._controls.values():
            found += control.drops()
        if self._advised is not None:
            found += self._advised.drops()
        found["request_wrong_tls"] += self._unknown_signal
        found["late"] = self._clock.late
        return dict(+found)

    def _end(self, reason: str) -> None:
        self._stage = Stage.OVER
        self._publish_trips(with_unfinished=True)
        waiting = self._world.waiting()
        self._context.world.publish("end", End(frames=self._ticks, reason=reason, waiting=waiting))
        _log.info(
            "%s after %d frames; since the start of warm-up: %s",
            reason,
            self._ticks,
            self._world.counts,
        )
        self._context.stop.set()


def _sumo_control(setup: Setup, world: World) -> dict[str, Cabinet] | None:
    """Returns the control that SUMO itself runs, by signal, if the scenario wants that."""
    config = CabinetConfig.model_validate(setup.scenario["cabinet"])
    if config.control != "actuated":
        return None
    found: dict[str, Cabinet] = {}
    for one in setup.road_map.intersections:
        world.run_actuated(one.tls, programme(one.signal, config), loop_parameters(config))
        found[one.tls] = ActuatedCabinet(one.signal, partial(world.shown, one.tls))
    return found


def _speed_advice(setup: Setup, world: World) -> AdvisedSpeeds | None:
    """Returns the handler of speed advice, if the scenario enables it."""
    signal = setup.scenario.get("signal", {})
    if not signal.get("speed_advice"):
        return None
    fastest_mps = max(lane.speed_mps for lane in setup.road_map.lanes)
    bounds = SpeedBounds(signal["advice_min_mps"], fastest_mps)
    lockstep = setup.scenario["mode"] == "lockstep"
    return AdvisedSpeeds(world, {*setup.road_map.by_tls}, bounds, lockstep=lockstep)
