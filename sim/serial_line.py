"""A twin on real wires: a pseudo-terminal and a TCP port, paced like a serial line, to be pulled out and put back."""

from __future__ import annotations

import contextlib
import os
import select
import socket
import threading
from bisect import bisect_right
from typing import TYPE_CHECKING, Protocol

from sim.faults import HungUp, PortDied
from sim.uart import as_heard, byte_times_s

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from devices.protocols import Clock
    from sim.faults import Delayed

CHUNK = 4096
ISPEED, OSPEED = 4, 5  # places in what tcgetattr returns
MISHEARD = b":N-1 \r\n"
UNPLUGGED_WITHIN_S = 5.0


class Channel(Protocol):
    """One way for bytes to a client and back."""

    def read(self) -> bytes:
        """Wait for bytes; none means that the client left."""
        ...

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""
        ...

    def client_baud(self) -> int | None:
        """Return the baud at which the client listens, None where there is no such thing."""
        ...


class PtyChannel:
    """The master's end of a pseudo-terminal; ``path`` is what a client opens; its baud counts unless ``any_baud``.

    Our own hold on the slave keeps the terminal alive while no client has it open. Both ends are raw: a fresh
    terminal would echo, and turn CR into LF. The thread that reads closes; others ask it to by `hang_up`.
    """

    def __init__(self, baud: int, *, any_baud: bool = False) -> None:
        import termios  # noqa: PLC0415  there are no terminals on Windows
        import tty  # noqa: PLC0415

        self._bauds = {getattr(termios, name): int(name[1:]) for name in dir(termios) if name[1:].isdigit()}
        self._tcgetattr = termios.tcgetattr
        self._any_baud = any_baud
        self._master, self._slave = os.openpty()
        self._woken, self._waker = os.pipe()
        self.path = os.ttyname(self._slave)
        tty.setraw(self._master)
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[ISPEED] = attributes[OSPEED] = getattr(termios, f"B{baud}", attributes[OSPEED])
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)

    def read(self) -> bytes:
        """Wait for bytes; none after `hang_up`."""
        ready, _, _ = select.select([self._master, self._woken], [], [])
        return b"" if self._woken in ready else os.read(self._master, CHUNK)

    def write(self, data: bytes) -> None:
        """Send all of ``data``."""
        while data:
            data = data[os.write(self._master, data) :]

    def client_baud(self) -> int | None:
        """Return the speed the slave is set to; None for one without a name, or if it does not matter."""
        return None if self._any_baud else self._bauds.get(self._tcgetattr(self._slave)[OSPEED])

    def hang_up(self) -> None:
        """Let the reader stop, from any thread."""
        os.write(self._waker, b"!")

    def close(self) -> None:
        """Close the terminal: a client sees its port vanish."""
        for end in (self._master, self._slave, self._woken, self._waker):
            os.close(end)


class SocketChannel:
    """A client of the TCP port."""

    def __init__(self, connection: socket.socket) -> None:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._connection = connection

    def read(self) -> bytes:
        """Wait for bytes; none means that the client left."""
        try:
            return self._connection.recv(CHUNK)
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        """Send all of ``data``; to nobody when the client has just left."""
        with contextlib.suppress(OSError):
            self._connection.sendall(data)

    def client_baud(self) -> int | None:
        """Return None: a socket has no baud."""
        return None


def converse(
    channel: Channel, feed: Callable[[bytes], list[Delayed]], baud: int, clock: Clock, *, misheard: bytes = MISHEARD
) -> None:
    """Answer a client until it leaves; bytes take as long as at ``baud``, in both directions.

    What comes at another baud makes no sense: the answer is ``misheard``, as the client's baud lets it hear it.

    Raises
    ------
    PortDied
        A fault ends the line.
    """
    while data := channel.read():
        clock.sleep(byte_times_s(len(data), baud, 0.0)[-1])
        client_baud = channel.client_baud()
        if client_baud not in (None, baud):
            channel.write(as_heard(misheard, baud, client_baud or baud))
            continue
        for reply in feed(data):
            clock.sleep(reply.delay_s)
            send_paced(channel, reply.data, baud, clock)


def send_paced(channel: Channel, data: bytes, baud: int, clock: Clock) -> None:
    """Send each byte when a wire of this baud would have brought it."""
    times_s, sent = byte_times_s(len(data), baud, clock.now()), 0
    while sent < len(data):
        clock.sleep(times_s[sent] - clock.now())
        due = max(bisect_right(times_s, clock.now()), sent + 1)
        channel.write(data[sent:due])
        sent = due


class SerialLine:
    """A twin on its wires. It is plugged in when made; `unplug` lets clients see it vanish, `plug` brings it back.

    Parameters
    ----------
    feed : callable
        Bytes in, replies out.
    baud : int
        Speed of the wire.
    clock : Clock
        Paces the bytes.
    link : Path, optional
        Where a link to the pseudo-terminal is kept: a name that stays when the line is plugged in again.
    misheard : bytes
        What the controller says to bytes of another baud; nothing, if it is one that keeps silent.
    any_baud : bool
        Whatever baud the client sets is right: a USB device has no wire that would be paced by it.
    """

    def __init__(
        self,
        feed: Callable[[bytes], list[Delayed]],
        baud: int,
        clock: Clock,
        *,
        link: Path | None = None,
        misheard: bytes = MISHEARD,
        any_baud: bool = False,
    ) -> None:
        self._feed = feed
        self._baud = baud
        self._clock = clock
        self._link = link
        self._misheard = misheard
        self._any_baud = any_baud
        self._tcp_port = 0
        self._pty: PtyChannel | None = None
        self._listener: socket.socket | None = None
        self._connection: socket.socket | None = None
        self._threads: list[threading.Thread] = []
        self._changing = threading.RLock()
        self.pty_path: str | None = None
        self.plug()

    @property
    def tcp_url(self) -> str:
        """The network port, as pyserial takes it."""
        return f"socket://127.0.0.1:{self._tcp_port}"

    @property
    def port(self) -> str:
        """The pseudo-terminal, or the network port where there are none."""
        return self.pty_path or self.tcp_url

    def plug(self) -> None:
        """Open the ports, under the same names as before; nothing happens when they are open."""
        with self._changing:
            if self._listener is not None:
                return
            self._listener = socket.create_server(("127.0.0.1", self._tcp_port), backlog=1)
            self._tcp_port = self._listener.getsockname()[1]
            self._threads = [_thread(self._serve_tcp, self._listener)]
            if hasattr(os, "openpty"):
                self._pty = PtyChannel(self._baud, any_baud=self._any_baud)
                self.pty_path = self._named(self._pty.path)
                self._threads.append(_thread(self._serve_pty, self._pty))

    def unplug(self) -> None:
        """Close all ports and wait until clients can see that they vanished."""
        with self._changing:
            listener, self._listener = self._listener, None
            for end in (listener, self._connection):
                if end is not None:
                    _shut(end)
            if self._pty is not None:
                self._pty.hang_up()
                self._pty = None
                if self._link is not None:
                    self._link.unlink(missing_ok=True)
            threads, self._threads = self._threads, []
        for thread in threads:
            if thread is not threading.current_thread():
                thread.join(UNPLUGGED_WITHIN_S)

    close = unplug

    def _named(self, path: str) -> str:
        if self._link is None:
            return path
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(path)
        return str(self._link)

    def _serve_pty(self, pty: PtyChannel) -> None:
        with contextlib.closing(pty):
            self._converse(pty)

    def _serve_tcp(self, listener: socket.socket) -> None:
        """Answer one client after the other."""
        with contextlib.suppress(OSError):
            while True:
                self._connection, _ = listener.accept()
                with self._connection as connection:
                    if listener is self._listener:
                        self._converse(SocketChannel(connection))

    def _converse(self, channel: Channel) -> None:
        try:
            converse(channel, self._feed, self._baud, self._clock, misheard=self._misheard)
        except HungUp:
            return
        except PortDied:
            self.unplug()


def _thread(function: Callable[..., None], argument: object) -> threading.Thread:
    thread = threading.Thread(target=function, args=[argument], daemon=True)
    thread.start()
    return thread


def _shut(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)
    connection.close()
