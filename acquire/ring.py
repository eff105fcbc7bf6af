"""Frames from one writer to many readers in any process, through shared memory, with nothing lost unseen.

The writer copies (or lets the camera write) each frame into a slot and then raises ``head``. A *lossless* reader sees
every frame in place and holds the writer back rather than miss one; a *latest* reader copies the newest and never
holds anybody back. For each of them, counted since it attached: ``received + lost + unread == published``.

`acquire.ring_layout` says how the file looks, `acquire.ring_locks` how one end knows whether the other lives, and
docs/decisions/0002-ring.md why.
"""

from acquire.ring_janitor import sweep_stale
from acquire.ring_reader import RingReader, WriterGone
from acquire.ring_writer import OpenSlot, ReaderStatus, RingFull, RingWriter, shared_memory_folder

__all__ = [
    "OpenSlot",
    "ReaderStatus",
    "RingFull",
    "RingReader",
    "RingWriter",
    "WriterGone",
    "shared_memory_folder",
    "sweep_stale",
]
