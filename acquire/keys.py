"""Who may come in from another computer: CURVE keys, and the list of those admitted.

A folder of keys holds ``server.key`` (public), ``server.key_secret``, and in ``clients`` the public key of everybody
admitted. Without that list the transport would admit any key; so an empty one is refused. Secret keys must not be
readable by others.
"""

from __future__ import annotations

import os
import stat
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import zmq.auth
from cyclopts import Parameter
from zmq.auth.thread import ThreadAuthenticator

from devices.errors import InputError, StereotomeError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from zmq import Context, Socket

SERVER = "server"
CLIENTS = "clients"
ZAP_DOMAIN = b"stereotome"


class KeysError(StereotomeError):
    """Keys are missing, or not kept secret."""

    code = "serve-keys"
    exit_code = 5


def keys(folder: Path, *, client: Annotated[str | None, Parameter(negative="")] = None) -> None:
    """Make the keys by which an instrument process is reached from other computers.

    Parameters
    ----------
    folder
        Where they are kept: server.key, server.key_secret, and clients/ with the public keys of those admitted.
    client
        Make a pair of keys for this person or computer, and admit it.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not (folder / f"{SERVER}.key_secret").exists():
        _make(folder, SERVER)
    if client is not None:
        _admit(folder, client)


def _admit(folder: Path, client: str) -> None:
    if Path(client).name != client or client in (SERVER, ""):
        raise InputError(f"{client!r} is no name for a key.", fix="take a plain name: --client ann", code="usage")
    secret = folder / f"{client}.key_secret"
    if secret.exists():
        raise InputError(f"{secret} exists already; nothing was made.", fix="choose another name", code="output-exists")
    _make(folder, client)
    admitted = folder / CLIENTS
    admitted.mkdir(mode=0o700, exist_ok=True)
    (folder / f"{client}.key").rename(admitted / f"{client}.key")


def _make(folder: Path, name: str) -> None:
    """Write a pair of keys, none of them ever readable by others."""
    before = os.umask(0o077)
    try:
        zmq.auth.create_certificates(folder, name)
    finally:
        os.umask(before)


def load_public(path: Path) -> bytes:
    """Return a public key; raises `KeysError` when the file holds none."""
    return _load(path)[0]


def load_secret(path: Path) -> tuple[bytes, bytes]:
    """Return a public and a secret key; raises `KeysError` when others may read the file, or it holds none."""
    if os.name == "posix" and path.exists() and stat.S_IMODE(path.stat().st_mode) & 0o077:
        raise KeysError(
            f"{path} may be read by others than its owner.",
            why="Whoever has read it can pose as its owner.",
            fix=f"chmod 600 {path}; if somebody may have read it, make new keys: stereotome keys",
        )
    public, secret = _load(path)
    if secret is None:
        raise KeysError(f"{path} holds no secret key.", fix="give the file that ends in .key_secret")
    return public, secret


def _load(path: Path) -> tuple[bytes, bytes | None]:
    try:
        return zmq.auth.load_certificate(path)
    except (OSError, ValueError) as cause:
        raise KeysError(f"{path} is no key file: {cause}", fix="make keys: stereotome keys DIR --client NAME") from None


class ServerKeys:
    """The keys of an instrument process, and its list of those admitted.

    Raises
    ------
    KeysError
        A key is missing or readable by others, or nobody is admitted.
    """

    def __init__(self, folder: Path) -> None:
        self.public, self._secret = load_secret(folder / f"{SERVER}.key_secret")
        self._admitted = folder / CLIENTS
        if not list(self._admitted.glob("*.key")):
            raise KeysError(
                f"{folder}: nobody is admitted.",
                why="Without a list of those admitted any key would open the instrument.",
                fix=f"admit somebody: stereotome keys {folder} --client NAME",
            )

    def guard(self, socket: Socket[bytes]) -> None:
        """Let only those admitted speak to a socket; before it is bound."""
        socket.curve_server = True
        socket.curve_secretkey = self._secret
        socket.zap_domain = ZAP_DOMAIN

    @contextmanager
    def gatekeeper(self, context: Context[Socket[bytes]]) -> Iterator[None]:
        """Answer, as long as the context lasts, who is admitted."""
        keeper = ThreadAuthenticator(context)
        keeper.start()
        keeper.configure_curve(domain=ZAP_DOMAIN.decode(), location=self._admitted)
        try:
            yield
        finally:
            keeper.stop()


class ClientKeys:
    """The keys by which a client is admitted: one file ``*.key_secret`` of its own, and the server's ``server.key``.

    Raises
    ------
    KeysError
        A key is missing, or there is more than one to choose from, or the secret one is readable by others.
    """

    def __init__(self, folder: Path) -> None:
        own = [path for path in sorted(folder.glob("*.key_secret")) if path.stem != SERVER]
        if len(own) != 1:
            raise KeysError(
                f"{folder} holds {len(own)} keys of clients, one is needed.",
                fix="keep in it your NAME.key_secret and the instrument's server.key, nothing else",
            )
        self._public, self._secret = load_secret(own[0])
        self._server = load_public(folder / f"{SERVER}.key")

    def use(self, socket: Socket[bytes]) -> None:
        """Show the keys at a socket; before it is connected."""
        socket.curve_publickey, socket.curve_secretkey = self._public, self._secret
        socket.curve_serverkey = self._server
