"""The one owner of devices, ring and run: carries out what is asked, and says how things stand."""

from __future__ import annotations

import logging
import threading
import time
from typing import TYPE_CHECKING, Any

from acquire import replies, requests
from acquire.comeback import Comeback
from acquire.hands import Hands
from acquire.hosted_run import HostedRun
from acquire.lanes import Job, Lane
from acquire.live import LiveView
from acquire.state import Scope
from acquire.stopper import stop_devices
from devices.errors import DeviceBusy, DeviceError, StereotomeError, Unsafe
from devices.values import Roi

if TYPE_CHECKING:
    from collections.abc import Callable

    from acquire.telemetry import Telemetry
    from devices.protocols import Clock
    from devices.rig import Rig

log = logging.getLogger(__name__)
IDLE = "IDLE"
LOOK_EVERY_S = 0.2
TELL_EVERY_S = 0.5
FEED_EVERY = 5  # looks at the stage for one at the feed
AGAIN_S = 0.1  # a stop is said again while the motion it met goes on
AGAIN = 5


class Host:
    """Requests go to one of three lanes: motion, camera, run. A run has all devices; by hand nothing is moved then.

    Parameters
    ----------
    rig : Rig
        The open instrument.
    telemetry : Telemetry
        Told of every change.
    """

    def __init__(self, rig: Rig, telemetry: Telemetry, clock: Clock) -> None:
        self._rig = rig
        self._clock = clock
        self._telemetry = telemetry
        self._z_um: float = float("nan")
        self._z_read_s = clock.now()
        self._feed_view: replies.FeedView | None = None
        self._holder = ""
        self._stops = 0
        self._stopping: set[object] = set()
        self._stopped, self._why_stopped = False, ""
        self._free = threading.Lock()
        self._by_hand = 0
        self._run_comes = False
        self._live_before = False
        self._hands = Hands(rig, clock)
        self._comeback = Comeback(rig.stage)
        self.live = LiveView(lambda: rig.camera, clock, rig.spec.camera.exposure_ms, lambda: self._z_um)
        self.run = HostedRun(rig, clock, self._run_told, self._run_over)
        self._lanes = {name: Lane(name, clock) for name in ("motion", "camera", "run")}
        self._over = threading.Event()
        self._look_now = threading.Event()
        self._tell_now = threading.Event()
        self._watches = [threading.Thread(target=do, name=do.__name__, daemon=True) for do in (self._look, self._tell)]
        for watch in self._watches:
            watch.start()

    @property
    def state(self) -> str:
        """``IDLE``, or the state of the run under way."""
        return self._standing()[0]

    def _standing(self) -> tuple[str, replies.RunView | None]:
        """Return the state and how the run stands, both of one moment: a run may begin or end in between."""
        while True:
            active, view = self.run.active, self.run.view()
            if active == self.run.active:
                return view.state if active and view else IDLE, view

    @property
    def ring(self) -> str:
        """File of the ring in which frames appear now; empty for none."""
        return self.run.ring_path or self.live.ring_path

    @property
    def in_use(self) -> bool:
        """Whether somebody commands, or a run is under way."""
        return bool(self._holder) or self.run.active

    def held_by(self, holder: str) -> None:
        """Note who commands."""
        if holder != self._holder:
            self._holder = holder
            self._look_now.set()

    def now(self) -> replies.State:
        """Return how things stand; asks no device."""
        known = self._z_um == self._z_um
        state, run = self._standing()
        height, width, *bands = self.live.caps.shape
        return replies.State(
            state=state,
            z_um=self._z_um if known else None,
            z_age_s=round(self._clock.now() - self._z_read_s, 3),
            live=self.live.running,
            exposure_ms=self.live.exposure_ms,
            ring=self.ring,
            camera=f"{width} x {height}{f' x {bands[0]}' if bands else ''} {self.live.caps.dtype}",
            holder=self._holder,
            stopped=self._stopped,
            why_stopped=self._why_stopped,
            run=run,
            feed=self._feed_view,
            utc_ns=time.time_ns(),
        )

    def put(self, request: requests.AnyRequest, wait_ms: int, answer: Callable[[replies.AnyReply], None]) -> None:
        """Have a request carried out in its lane; ``answer`` is called there with what came of it.

        Raises
        ------
        DeviceBusy
            Too much waits already.
        """
        stops, lane = self._stops, self._lanes[request.lane]
        moves = request.lane == "motion" or isinstance(request, requests.StartRun | requests.ContinueRun)
        lane.put(
            Job(
                work=lambda: self._carry_out(request),
                begin_by_s=self._clock.now() + wait_ms / 1000,
                wanted=lambda: not moves or stops == self._stops,
                answer=answer,
            )
        )

    def stop_all(self, why: str = "") -> replies.Stopped:
        """Stop all motion now: every device by its own way past whatever is going on; waits for no lock.

        Motion is refused afterwards until `ClearStop`. May be called by any thread, and again at any time; ``why``
        is told where nobody asked for it.
        """
        this = object()
        self._stopping.add(this)
        self._stops += 1
        self._stopped, self._why_stopped = True, why or self._why_stopped
        session = self.run.session() if self.run.active else None
        try:
            told = stop_devices(self._rig, session.stop if session else None)
            for _ in range(AGAIN):  # a motion that was just about to begin when the first word went out
                if not self._lanes["motion"].busy:
                    break
                self._clock.sleep(AGAIN_S)
                stop_devices(self._rig, None)
        finally:
            self._stopping.discard(this)
        self._look_now.set()
        return told

    def close(self) -> None:
        """End the run after its plane, everything else at once."""
        self.run.end()
        for lane in self._lanes.values():
            lane.close()
        self._over.set()
        self._look_now.set()
        self._tell_now.set()
        for watch in self._watches:
            watch.join()
        self.live.close()

    def _carry_out(self, request: requests.AnyRequest) -> replies.AnyReply:
        self._check_expected(request)
        if request.lane == "run":
            return self._about_run(request)
        if isinstance(request, requests.ClearStop):
            return self._release()
        if self._stopped and request.lane == "motion":
            raise Unsafe("the instrument was stopped. Nothing moved.", fix="clear the stop first", code="serve-stopped")
        self._take_by_hand()
        try:
            return self._by_hand_do(request)
        finally:
            with self._free:
                self._by_hand -= 1
            self._look_now.set()

    def _release(self) -> replies.Done:
        """Allow motion again, once every stop under way has said its last word: it would stop what moves then."""
        stops = self._stops
        while self._stopping:
            self._clock.sleep(AGAIN_S)
        self._stopped, self._why_stopped = False, ""
        if stops != self._stops:
            self._stopped = True
            raise Unsafe("a further stop came before the release. It stays stopped.", code="serve-stopped")
        self._look_now.set()
        return replies.Done()

    def _check_expected(self, request: requests.AnyRequest) -> None:
        state = self.state
        if request.expect_state not in (None, state):
            raise _unexpected(f"the state is {state}, not {request.expect_state}")
        if request.expect_section is not None and request.expect_section != (section := self._section()):
            raise _unexpected(f"the section is {section}, not {request.expect_section}")

    def _section(self) -> int:
        view = self.run.view() if self.run.active else None
        return self._hands.cuts() if view is None else view.section

    def _take_by_hand(self) -> None:
        with self._free:
            if self.run.active or self._run_comes:
                raise DeviceBusy(
                    "a run has the devices. Nothing was done.", fix="wait for its end, or end it", code="run-active"
                )
            self._by_hand += 1

    def _by_hand_do(self, request: requests.AnyRequest) -> replies.AnyReply:
        match request:
            case requests.MoveStage():
                self._comeback.check()
                return self._arrived(self._hands.move(request.z_um))
            case requests.JogStage():
                self._comeback.check()
                return self._arrived(self._hands.jog(request.by_um))
            case requests.ZeroStage():
                self._comeback.take_as_it_is()
                return self._arrived(self._hands.zero())
            case _ if request.lane == "camera":
                return self._with_camera(request)
            case _:
                try:
                    return self._with_feed(request)
                finally:  # nobody who asks after the answer is told an older place
                    self._read_feed()

    def _arrived(self, position: replies.Position) -> replies.Position:
        """Note where the stage rests, so that nobody who asks after the answer is told an older place."""
        self._stands(position.z_um)
        return position

    def _stands(self, z_um: float) -> None:
        self._z_um, self._z_read_s = z_um, self._clock.now()
        self._comeback.knew(z_um)

    def _with_feed(self, request: requests.AnyRequest) -> replies.AnyReply:
        match request:
            case requests.ApproachSection():
                return self._hands.approach(request.depth_um)
            case requests.HomeFeed():
                return self._hands.home()
            case requests.RetractKnife():
                return self._hands.retract()
            case requests.FeedSection():
                return self._hands.feed(request.thickness_nm)
            case requests.CutSection():
                return self._hands.cut()
            case requests.ArmKnife():
                self._hands.arm()
                return replies.Done()
            case _:
                raise AssertionError(request)

    def _with_camera(self, request: requests.AnyRequest) -> replies.AnyReply:
        match request:
            case requests.Snap():
                return self.live.snap(self._rig.stage.position_um())
            case requests.StartLive():
                self.live.start(request.frames_per_s)
            case requests.StopLive():
                self.live.stop()
            case requests.SetCamera():
                self.live.configure(request.exposure_ms, None if request.roi is None else Roi(*request.roi))
            case _:
                raise AssertionError(request)
        return replies.Done()

    def _about_run(self, request: requests.AnyRequest) -> replies.AnyReply:
        match request:
            case requests.StartRun() | requests.ContinueRun():
                return self._begin(request)
            case requests.PlanRun():
                return self.run.planned(request, self.live.caps)
            case requests.NoteRun():
                self.run.session().note(request.text)
            case requests.PauseRun():
                self.run.session().pause(Scope(request.scope))
            case requests.ResumeRun():
                self.run.session().resume()
            case requests.CancelRun():
                self.run.session().cancel()
            case requests.AnswerRun():
                self.run.session().answer(request.choice)
            case _:
                raise AssertionError(request)
        self._look_now.set()
        return replies.Done()

    def _begin(self, request: requests.StartRun | requests.ContinueRun) -> replies.Started:
        """Take all devices for a run; the live view goes on after it."""
        if self._stopped:
            raise Unsafe("the instrument was stopped. Nothing moved.", fix="clear the stop first", code="serve-stopped")
        self._comeback.check()
        with self._free:
            if self.run.active or self._by_hand:
                raise DeviceBusy(
                    "the devices are in use. Nothing was started.", fix="wait, or end it", code="run-active"
                )
            self._run_comes = True
        self._live_before = self.live.running
        try:
            self.live.stop()
            return self.run.start(request) if isinstance(request, requests.StartRun) else self.run.go_on(request)
        except StereotomeError:
            self._live_again()
            raise
        finally:
            self._run_comes = False
            self._look_now.set()

    def _run_told(self, event: dict[str, Any]) -> None:
        if event["event"] == "plane":
            self._stands(event["z_um"])
        self._telemetry.tell("run", replies.Event(event=event))
        self._look_now.set()

    def _run_over(self) -> None:
        self._live_again()
        self._look_now.set()

    def _live_again(self) -> None:
        if self._live_before and not self._over.is_set():
            try:
                self.live.start(self.live.frames_per_s)
            except StereotomeError as error:
                log.warning("live: %s", error.what)

    def _look(self) -> None:
        """Read the devices now and then while they are free."""
        looks = 0
        while not self._over.is_set():
            self._look_now.wait(LOOK_EVERY_S)
            self._look_now.clear()
            if not self.run.active and not self._run_comes:
                self._read(with_feed=looks % FEED_EVERY == 0)
            looks += 1
            self._tell_now.set()

    def _tell(self) -> None:
        """Tell how things stand after every look, and while a look waits for a device that does not answer."""
        while not self._over.is_set():
            self._tell_now.wait(TELL_EVERY_S)
            self._tell_now.clear()
            self._telemetry.tell("state", self.now())

    def _read(self, *, with_feed: bool) -> None:
        try:
            z_um = self._comeback.read_um(may_meet=not self._lanes["motion"].busy)
            if z_um is not None:
                self._z_um, self._z_read_s = z_um, self._clock.now()
        except DeviceError as error:
            log.warning("%s", error.what)
        if with_feed and not self._lanes["motion"].busy:
            self._read_feed()

    def _read_feed(self) -> None:
        try:
            self._feed_view = self._hands.look_at_feed()
        except DeviceError as error:
            log.warning("%s", error.what)


def _unexpected(what: str) -> Unsafe:
    return Unsafe(f"{what}. Nothing was done.", fix="look how things stand, then ask again", code="serve-expected")
