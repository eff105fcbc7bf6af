"""Starts the observer's page as a process of its own, and ends it."""

from __future__ import annotations

import ipaddress
import secrets
import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

from acquire.meeting import host_and_port
from devices.errors import DeviceBusy

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

END_S = 5.0


def observed_at(wanted: bool | str) -> tuple[str, int] | None:  # noqa: FBT001  as the command line gives it
    """Return address and port of the page, port 0 for any; None when none is wanted.

    Raises
    ------
    InputError
        It is no address.
    """
    if wanted is False:
        return None
    return ("127.0.0.1", 0) if wanted is True else host_and_port(wanted)


@contextmanager
def observer_page(connection: Path, host: str, port: int) -> Iterator[str]:
    """Serve the page as long as the context lasts; gives its address.

    An address that others can reach gets a random word into its path: who does not know it sees nothing.

    Raises
    ------
    DeviceBusy
        Nothing can be served there.
    """
    token = "" if ipaddress.ip_address(host).is_loopback else secrets.token_urlsafe(16)
    process = subprocess.Popen(
        [sys.executable, "-m", "acquire.web", str(connection), host, str(port), token],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C is for the one who started it; it ends with its standard input
    )
    assert process.stdout is not None
    try:
        if not (address := process.stdout.readline().strip()):
            raise DeviceBusy(
                f"no page can be shown at {host}:{port}; it said why above.",
                fix="choose another port: --observe=ADDRESS:PORT",
                code="serve-busy",
            )
        yield address
    finally:
        try:
            process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
