"""Look at the newest frame from another computer: small pictures over the network in place of shared memory."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING

import msgspec
import zmq

from acquire.messages import unpack_telling
from acquire.preview import looked_at
from acquire.replies import Preview

if TYPE_CHECKING:
    from acquire.frame import Frame
    from acquire.keys import ClientKeys

log = logging.getLogger(__name__)
HELD = 2  # pictures that wait; who looks seldom gets the newest


class PreviewViewer:
    """The newest previews of an instrument, for one thread. Holds nobody up.

    Parameters
    ----------
    endpoint : str
        Where they are published.
    keys : ClientKeys or None
        Of a client that has to be admitted.
    """

    def __init__(self, endpoint: str, keys: ClientKeys | None) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.SUB)
        self._socket.linger = 0
        self._socket.ipv6 = True
        self._socket.rcvhwm = HELD
        self._socket.subscribe(b"")
        if keys is not None:
            keys.use(self._socket)
        self._socket.connect(endpoint)

    def newest(self) -> Frame | None:
        """Return the newest frame not seen yet, or None."""
        told = None
        while self._socket.poll(0):
            told = self._socket.recv()
        if told is None:
            return None
        try:
            _, telling = unpack_telling(told)
            return looked_at(telling.told) if isinstance(telling.told, Preview) else None
        except (msgspec.DecodeError, ValueError) as cause:
            log.warning("a preview that cannot be read: %s", cause)
            return None

    def close(self) -> None:
        """Leave."""
        self._socket.close(0)
        self._context.term()
