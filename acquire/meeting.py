"""Where an instrument process and its clients meet: sockets for this user alone, and the file that names them."""

from __future__ import annotations

import fcntl
import ipaddress
import os
import re
import secrets
import stat
import tempfile
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import msgspec

from acquire.keys import KeysError
from devices.errors import DeviceBusy, DeviceError, InputError, StereotomeError

if TYPE_CHECKING:
    from collections.abc import Iterator

Channel = Literal["control", "stop", "telemetry", "preview"]
CHANNELS: tuple[Channel, ...] = ("control", "stop", "telemetry", "preview")


class ServerGone(DeviceError):
    """The instrument process does not answer."""

    code = "serve-silent"


class Meeting(msgspec.Struct, frozen=True):
    """What a connection file says: who serves, where, and the word that lets in.

    Attributes
    ----------
    endpoints : dict
        Address of each channel: ``ipc://…`` or ``tcp://…``.
    key : str
        To be sent with every message.
    """

    instrument: str
    pid: int
    endpoints: dict[Channel, str]
    key: str


def runtime_folder() -> Path:
    """Return the folder for this user's sockets and connection files; nobody else may look into it.

    Raises
    ------
    StereotomeError
        It belongs to somebody else (``serve-folder``).
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    folder = Path(base) / "stereotome" if base else Path(tempfile.gettempdir()) / f"stereotome-{os.getuid()}"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or stat.S_IMODE(found.st_mode) & 0o077:
        raise StereotomeError(
            f"{folder} does not belong to you alone.",
            why="Programs of others could pose as the instrument.",
            fix=f"look who made it, then: chmod 700 {folder}",
            code="serve-folder",
        )
    return folder


def connection_file(instrument: str) -> Path:
    """Return the connection file of an instrument, by its name."""
    return runtime_folder() / f"{re.sub(r'[^A-Za-z0-9._-]', '_', instrument)[:60]}.json"


def addresses(bind: str | None, *, keyed: bool) -> dict[Channel, str]:
    """Return the addresses to serve at.

    Parameters
    ----------
    bind : str or None
        ``"127.0.0.1"`` or ``"192.168.7.2:5570"``: four ports from the one given on, or any four. None: sockets in
        the file system, which only this user can reach.
    keyed : bool
        Whether keys and a list of those admitted guard the sockets.

    Raises
    ------
    InputError
        ``bind`` is no address.
    KeysError
        It is an address that others can reach, and nothing guards it.
    """
    if bind is None:
        tag = secrets.token_hex(4)
        return {channel: f"ipc://{runtime_folder()}/{tag}.{channel}" for channel in CHANNELS}
    host, port = host_and_port(bind)
    if not keyed and not ipaddress.ip_address(host).is_loopback:
        raise KeysError(
            f"{bind} can be reached from other computers, and nothing guards it. Nothing was opened.",
            fix=("make keys, then serve with them: --keys DIR", "leave --bind out and come by ssh"),
        )
    written = f"[{host}]" if ":" in host else host
    return {channel: f"tcp://{written}:{port + index if port else '*'}" for index, channel in enumerate(CHANNELS)}


def host_and_port(bind: str) -> tuple[str, int]:
    """Return the two parts of an address, port 0 when it has none; raises `InputError` for anything else."""
    host, _, port = (
        bind.rpartition(":") if bind.count(":") == 1 or (bind.startswith("[") and "]:" in bind) else (bind, "", "0")
    )
    try:
        number, address = int(port), str(ipaddress.ip_address(host.strip("[]")))
    except ValueError:
        raise InputError(
            f"{bind!r} is no address to serve at.", fix="write --bind 127.0.0.1:5570", code="usage"
        ) from None
    if not 0 <= number <= 65535 - len(CHANNELS):
        raise InputError(f"{number} is no port to serve at.", fix="write --bind 127.0.0.1:5570", code="usage")
    return address, number


@contextmanager
def claimed(instrument: str) -> Iterator[Path]:
    """Be the only process that serves this instrument as long as the context lasts; gives its connection file.

    Raises
    ------
    DeviceBusy
        Another one serves it (``serve-busy``).
    """
    path = connection_file(instrument)
    with ExitStack() as undo:
        lock = os.open(path.with_suffix(".lock"), os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        undo.callback(os.close, lock)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise DeviceBusy(
                f"the instrument '{instrument}' is being served already.",
                fix=("use that process: stereotome run RECIPE --server", f"its connection file is {path}"),
                code="serve-busy",
            ) from None
        undo.callback(path.unlink, missing_ok=True)
        yield path


def write_meeting(path: Path, meeting: Meeting) -> None:
    """Write a connection file, all of it or nothing, readable by its owner alone."""
    part = path.with_suffix(".part")
    part.unlink(missing_ok=True)
    handle = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    with os.fdopen(handle, "wb") as file:
        file.write(msgspec.json.encode(meeting))
    part.rename(path)


def find_meeting(name: Path | str | None) -> Meeting:
    """Return what a connection file says.

    Parameters
    ----------
    name : Path, str or None
        The file, or an instrument's name; None for the only instrument served by this user.

    Raises
    ------
    ServerGone
        No process serves it.
    InputError
        The file is none, or there are several instruments to choose from.
    """
    path = _path_of(name)
    try:
        meeting = msgspec.json.decode(path.read_bytes(), type=Meeting)
    except OSError:
        raise _nobody(f"nobody serves {name or path}") from None
    except msgspec.DecodeError as cause:
        raise InputError(f"{path} is no connection file: {cause}", fix="give that of a running server") from None
    return meeting


def _path_of(name: Path | str | None) -> Path:
    if name is not None:
        return Path(name) if os.sep in str(name) or Path(name).suffix == ".json" else connection_file(str(name))
    files = sorted(path for path in runtime_folder().glob("*.json") if is_served(path))
    if len(files) > 1:
        names = ", ".join(path.stem for path in files)
        raise InputError(f"several instruments are served: {names}.", fix="name one of them", code="usage")
    if not files:
        raise _nobody("no instrument is served here")
    return files[0]


def is_served(path: Path) -> bool:
    """Tell whether the process that wrote a connection file lives: it holds the lock beside it."""
    try:
        with path.with_suffix(".lock").open("rb") as lock:
            fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _nobody(what: str) -> ServerGone:
    return ServerGone(f"{what}.", fix="start it: stereotome serve -i RIG.toml")
