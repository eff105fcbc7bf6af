"""Shutter glasses behind an Open3DOLED emitter as a `devices.protocols.Eyewear`."""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import replace
from statistics import median
from threading import RLock
from typing import TYPE_CHECKING

from devices.errors import DeviceError, LimitError, LinkLost, MalformedReply, NoReply
from devices.glasses_spec import LEAST_REFRESH_HZ, MOST_REFRESH_HZ
from devices.glasses_timing import Edge, EyewearTiming, Lock
from devices.link import Link
from devices.transport.serial_port import SerialPort
from devices.transport.transcript import Recorder
from devices.wire import open3d

if TYPE_CHECKING:
    from collections.abc import Iterator

    from devices.glasses_spec import GlassesSpec
    from devices.glasses_timing import Eye
    from devices.protocols import Clock, Transport
    from devices.registry import DeviceContext
    from devices.wire.open3d import Glasses, Settings

DEVICE = "glasses"
REPLY_TIMEOUT_S = 0.3
EXCHANGES_TIMED = 5
FIT_S = 0.5e-3  # a lock farther from the flips is made anew
SURE_S = 0.75e-3  # how well the moment of arrival must be known
LOCK_ATTEMPTS = 8
KEPT_EDGES = 1 << 14
KEPT_LOCKS = 1024
US_PER_S = 1e6


class Open3dGlasses:
    """Drives the emitter; every method may be called from any thread, one at a time.

    In a free run the emitter sends nothing back about its turns, and its crystal and ours drift apart. So the run is
    started anew every ``relock_s``, with a line so timed that it arrives at a flip of the left eye.

    Parameters
    ----------
    transport : Transport
        To the emitter; `Link` and the per-frame turns, which have no reply, share it.
    spec : GlassesSpec
        ``[glasses]`` of the instrument file.
    clock : Clock
        Time.
    """

    def __init__(self, transport: Transport, spec: GlassesSpec, clock: Clock) -> None:
        self._transport = transport
        self._link = Link(transport, clock, terminator=open3d.TERMINATOR, timeout_s=REPLY_TIMEOUT_S)
        self._spec = spec
        self._clock = clock
        self._turn = RLock()
        self._settings: Settings | None = None
        self._quickest_s = self._usual_s = 0.0
        self._edges: deque[Edge] = deque(maxlen=KEPT_EDGES)
        self._sent = 0
        self._locks: deque[Lock] = deque(maxlen=KEPT_LOCKS)
        self._locked = self._closed = False

    @property
    def free_running(self) -> bool:
        """Whether the instrument file wants a free run."""
        return self._spec.drive == "free-run"

    @property
    def timing(self) -> EyewearTiming:
        """What was sent and when; in a free run the locks, for the emitter is silent about its turns."""
        return EyewearTiming(tuple(self._edges), self._sent, tuple(self._locks), self._locked, self._latency_s)

    def show(self, eye: Eye) -> None:
        """Give one eye its turn now. The emitter does not answer: of a lost line, only the wearer knows."""
        with self._conversation():
            self._notice_restart()
            if self._known().drive_mode != open3d.DriveMode.PC_SERIAL:
                self.both_open()
            self._edges.append(Edge(round(self._clock.now() * 1e9), eye))
            self._sent += 1
            self._transport.write(open3d.turn(eye))

    def both_open(self) -> None:
        """Give no more turns: glasses that hear nothing for a fifth of a second become clear."""
        with self._conversation():
            self._locked = False
            self._store(replace(self._known(), drive_mode=open3d.DriveMode.PC_SERIAL))

    def lock_to(self, refresh_hz: float, left_flip_s: float) -> None:
        """Run free in step with a display; sends when the lock is due again or does not fit the flip.

        Raises
        ------
        LimitError
            No rate for glasses; nothing was sent.
        DeviceError
            glasses-unlocked: no exchange was quick enough to be sure of the phase.
        LinkError
            The emitter did not answer, or not as it should; the glasses are not locked.
        """
        check_refresh(refresh_hz)
        with self._conversation():
            self._notice_restart()
            if not self._holds(refresh_hz, left_flip_s):
                self._lock(refresh_hz, left_flip_s)

    def close(self) -> None:
        """End the turns and release the port; the glasses become clear."""
        if self._closed:
            return
        with contextlib.suppress(DeviceError):
            self.both_open()
        self.leave()

    def settings(self) -> Settings:
        """Return the emitter's settings, read now."""
        with self._conversation():
            self._settings = self._link.ask(open3d.query())
            return self._settings

    def swap_eyes(self) -> Settings:
        """Exchange the eyes until power-off, and return the settings read back."""
        with self._conversation():
            settings = self.settings()
            return self.store(replace(settings, flip_eyes=1 - settings.flip_eyes))

    def set_view(self, glasses: Glasses) -> None:
        """Let the glasses show stereo, or one eye's picture to both."""
        with self._conversation():
            self._link.ask(open3d.view(glasses))

    def store(self, settings: Settings) -> Settings:
        """Set all settings until power-off; raises `DeviceError` (glasses-settings) unless every one was taken."""
        with self._conversation():
            self._locked = False
            return self._store(settings)

    def leave(self) -> None:
        """Release the port and let the emitter go on as it is."""
        self._closed = True
        self._link.close()

    def save(self) -> None:
        """Write the settings into the EEPROM."""
        with self._conversation():
            self._link.ask(open3d.save())

    def prepare(self) -> None:
        """Read the settings, set what the instrument file wants, and time some exchanges.

        Raises
        ------
        LinkError
            No valid answer.
        DeviceError
            glasses-settings: the emitter did not take a setting.
        """
        with self._conversation():
            settings = self._with_spec(self.settings())
            took_s = sorted(self._timed_store(settings) for _ in range(EXCHANGES_TIMED))
            self._quickest_s, self._usual_s = took_s[0], median(took_s)

    def round_trip_s(self) -> float:
        """Send the settings once more, unchanged, and return how long the answer took."""
        with self._conversation():
            return self._timed_store(self._known())

    @contextlib.contextmanager
    def _conversation(self) -> Iterator[None]:
        """One at a time; when the emitter is gone, nothing is known of it any more."""
        with self._turn:
            try:
                yield
            except LinkLost:
                self._settings, self._locked = None, False
                raise

    @property
    def _latency_s(self) -> float:
        given_ms = self._spec.latency_ms
        return self._usual_s / 2 if given_ms is None else given_ms / 1000

    def _holds(self, refresh_hz: float, left_flip_s: float) -> bool:
        if not self._locked:
            return False
        last = self._locks[-1]
        fresh = self._clock.now() - last.left_s < self._spec.relock_s
        return fresh and last.refresh_hz == refresh_hz and abs(last.phase_s(left_flip_s)) <= FIT_S

    def _lock(self, refresh_hz: float, left_flip_s: float) -> None:
        self._locked = False
        for _ in range(LOCK_ATTEMPTS):
            lock = self._start(refresh_hz, left_flip_s)
            if lock.uncertainty_s <= SURE_S:
                self._locks.append(lock)
                self._locked = True
                return
        raise DeviceError(
            f"glasses: not locked to the display: the answer took {2 * lock.uncertainty_s * 1000:.1f} ms too long.",
            why="When the emitter was reached cannot be told to a millisecond; the computer or its USB is too busy.",
            fix=("close what else works on this computer.", "plug the emitter in without a hub."),
            code="glasses-unlocked",
        )

    def _start(self, refresh_hz: float, left_flip_s: float) -> Lock:
        """Start a free run so that the line arrives with the next flip of the left eye."""
        settings = self._free_run(refresh_hz)
        due_s = self._next_left_s(refresh_hz, left_flip_s) - self._latency_s
        self._clock.sleep(due_s - self._clock.now())
        sent_s = self._clock.now()
        took_s = self._timed_store(settings)
        return self._made(refresh_hz, sent_s, took_s)

    def _made(self, refresh_hz: float, sent_s: float, took_s: float) -> Lock:
        """Return the lock that an exchange made: whatever it took too long may be on either way."""
        uncertainty_s = max(took_s - self._quickest_s, 0.0) / 2
        arrived_s = sent_s + self._latency_s if self._spec.latency_ms is not None else sent_s + took_s / 2
        return Lock(refresh_hz, arrived_s, uncertainty_s)

    def _next_left_s(self, refresh_hz: float, left_flip_s: float) -> float:
        cycle_s = 2 / refresh_hz
        earliest_s = self._clock.now() + self._latency_s
        return earliest_s + (left_flip_s - earliest_s) % cycle_s

    def _free_run(self, refresh_hz: float) -> Settings:
        """Return settings that start a free run: only a changed frame time or mode does so."""
        settings = self._known()
        period_us = US_PER_S / refresh_hz
        nearest = round(period_us)
        second = nearest + (1 if period_us >= nearest else -1)
        running = settings.drive_mode == open3d.DriveMode.FREE_RUN and settings.frametime_us == nearest
        return replace(settings, drive_mode=open3d.DriveMode.FREE_RUN, frametime_us=second if running else nearest)

    def _known(self) -> Settings:
        """Return the settings; asks for them and sets the file's when they are not known."""
        if self._settings is None:
            self._store(self._with_spec(self.settings()))
        assert self._settings is not None
        return self._settings

    def _with_spec(self, settings: Settings) -> Settings:
        spec = self._spec
        wanted = {
            "ir_protocol": spec.ir_protocol,
            "frame_delay_us": spec.delay_us,
            "frame_duration_us": spec.open_us,
            "flip_eyes": spec.swap if spec.swap is None else int(spec.swap),
        }
        return replace(settings, **{key: value for key, value in wanted.items() if value is not None})

    def _timed_store(self, settings: Settings) -> float:
        before_s = self._clock.now()
        self._store(settings)
        return self._clock.now() - before_s

    def _store(self, settings: Settings) -> Settings:
        """Set all settings and compare what comes back; until it does, nothing is known."""
        self._settings = None
        taken = self._link.ask(open3d.store(settings))
        if taken != settings:
            raise _not_taken(settings, taken)
        self._settings = taken
        return taken

    def _notice_restart(self) -> None:
        """Read what came unasked; an emitter that lost its power says so when it is back, and has lost its settings."""
        unasked = self._transport.read(0)
        if any(word.encode() in unasked for word in open3d.BANNER):
            self._settings, self._locked = None, False


def check_refresh(refresh_hz: float) -> None:
    """Raise `LimitError` for a rate at which no glasses work; a NaN is none."""
    if not LEAST_REFRESH_HZ <= refresh_hz <= MOST_REFRESH_HZ:
        raise LimitError(
            f"glasses: {refresh_hz:g} Hz is outside {LEAST_REFRESH_HZ:g} … {MOST_REFRESH_HZ:g} Hz. Nothing was sent.",
            fix="set refresh_hz to what the display does: 120 for most.",
        )


def open_glasses(table: GlassesSpec, context: DeviceContext) -> Open3dGlasses:
    """Open the port, make sure that an emitter answers, and set what the file wants; its EEPROM is left alone.

    Raises
    ------
    DeviceError
        device-missing, device-permission, device-busy; device-silent or device-garbled when no valid answer comes;
        glasses-settings when a setting was not taken.
    """
    transport: Transport = SerialPort(table.port, open3d.BAUD, device=DEVICE)
    try:
        if context.transcript is not None:
            transport = Recorder(transport, context.transcript / "glasses.jsonl", context.clock)
        glasses = Open3dGlasses(transport, table, context.clock)
        _greet(glasses, table)
    except BaseException:
        transport.close()
        raise
    return glasses


def _greet(glasses: Open3dGlasses, table: GlassesSpec) -> None:
    try:
        glasses.prepare()
    except (NoReply, MalformedReply) as error:
        received = error.reply if isinstance(error, MalformedReply) else error.received
        came = f"{error.what}" if received else "nothing came back"
        raise DeviceError(
            f"glasses: no valid answer from {table.port}.",
            why=f"The port opened, but {came}",
            fix=(
                "check that this is the emitter's port: stereotome devices list",
                "plug the emitter out and in, and wait until its light is steady.",
                *error.fix,
            ),
            code="device-garbled" if received else "device-silent",
        ) from error


def _not_taken(wanted: Settings, taken: Settings) -> DeviceError:
    differences = [
        f"{name} {getattr(wanted, name)} became {getattr(taken, name)}"
        for name in wanted.__dataclass_fields__
        if getattr(wanted, name) != getattr(taken, name)
    ]
    return DeviceError(
        f"glasses: the emitter did not take every setting: {', '.join(differences)}.",
        why="Its firmware knows no such value.",
        fix="choose other values under [glasses] in the instrument file.",
        code="glasses-settings",
    )
