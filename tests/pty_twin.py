"""A twin behind a pseudo-terminal, served by a thread of the test."""

import os
import threading
import tty


class OnPty:
    """Gives what comes to ``feed``, and sends back its replies, until it is closed; ``port`` is its name."""

    def __init__(self, feed):
        self._master, self._slave = os.openpty()
        tty.setraw(self._master)
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._thread = threading.Thread(target=self._serve, args=[feed])
        self._thread.start()

    def _serve(self, feed):
        data = b""
        while not data.endswith(b"\0"):  # what was said last may lie before it
            data = os.read(self._master, 4096)
            for reply in feed(data.rstrip(b"\0")):
                os.write(self._master, reply)

    def close(self):
        os.write(self._slave, b"\0")
        self._thread.join()
        os.close(self._master)
        os.close(self._slave)
