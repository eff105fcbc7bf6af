"""Whatever anybody does in whatever order: the ring agrees with a list, and nothing is lost unseen."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from acquire.frame import FrameHeader
from acquire.ring import RingFull, RingReader, RingWriter

SHAPE = (3, 7)


class ManualClock:
    """Time that passes only while somebody sleeps."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def now(self) -> float:
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds


class Observed:
    """A reader and what must be true of it."""

    def __init__(self, writer, kind, clock):
        self.reader = RingReader.attach(writer.path, kind, clock=clock)
        self.joined = writer.published
        self.numbers = []
        self.held = None

    def read(self):
        self.held = self.reader.read(0)
        if self.held is not None:
            assert (self.held.pixels == self.held.number).all()
            assert self.held.header.plane == self.held.number
            assert self.held.number >= self.joined
            self.numbers.append(self.held.number)

    def release(self):
        self.reader.release()
        self.held = None

    def needed(self):
        """Return the first frame a lossless reader still needs."""
        return self.joined + len(self.numbers) - (self.held is not None)


class Ring(RuleBasedStateMachine):
    @initialize(slots=st.integers(2, 5))
    def create(self, slots):
        self.clock = ManualClock()
        self.slots = slots
        self.writer = RingWriter.create("model", SHAPE, "uint16", slots, clock=self.clock)
        self.lossless = Observed(self.writer, "lossless", self.clock)
        self.latest = []
        self.refused = 0

    @rule(count=st.integers(1, 4))
    def push(self, count):
        for _ in range(count):
            number = self.writer.published
            pixels = np.full(SHAPE, number, np.uint16)
            header = FrameHeader(plane=number, setpoint_um=0, z_um=0, exposure_ms=1)
            if number - self.slots < self.lossless.needed():
                assert self.writer.push(pixels, header, timeout_s=0) == number
            else:
                self.refused += 1
                with pytest.raises(RingFull):
                    self.writer.push(pixels, header, timeout_s=0)

    @rule()
    def abandon_a_slot(self):
        if self.writer.published - self.slots < self.lossless.needed():
            with self.writer.slot(timeout_s=0) as slot:
                slot.pixels[...] = 65535

    @rule()
    def read_lossless(self):
        before = len(self.lossless.numbers)
        self.lossless.read()
        assert self.lossless.numbers == list(range(len(self.lossless.numbers)))
        assert (len(self.lossless.numbers) > before) == (before < self.writer.published)

    @rule()
    def release_lossless(self):
        self.lossless.release()

    @precondition(lambda self: len(self.latest) < 3)
    @rule()
    def join(self):
        self.latest.append(Observed(self.writer, "latest", self.clock))

    @precondition(lambda self: self.latest)
    @rule(data=st.data())
    def read_latest(self, data):
        observed = data.draw(st.sampled_from(self.latest))
        new = observed.reader.unread
        observed.read()
        assert (observed.held is not None) == (new > 0)
        assert observed.held is None or observed.held.number == self.writer.published - 1

    @precondition(lambda self: self.latest)
    @rule(data=st.data())
    def leave(self, data):
        observed = data.draw(st.sampled_from(self.latest))
        self.latest.remove(observed)
        observed.reader.close()

    @invariant()
    def every_frame_is_accounted_for(self):
        for observed in (self.lossless, *self.latest):
            reader = observed.reader
            assert reader.received == len(observed.numbers)
            assert reader.received + reader.lost + reader.unread == self.writer.published - observed.joined
            assert observed.numbers == sorted(set(observed.numbers))
        assert self.lossless.reader.lost == 0
        assert self.writer.refused == self.refused

    @invariant()
    def a_frame_in_hand_never_changes(self):
        for observed in (self.lossless, *self.latest):
            assert observed.held is None or (observed.held.pixels == observed.held.number).all()

    @invariant()
    def the_writer_sees_the_same(self):
        seen = sorted((s.kind, s.received, s.lost) for s in self.writer.readers())
        true = [(o.reader.kind, o.reader.received, o.reader.lost) for o in (self.lossless, *self.latest)]
        assert seen == sorted(true)

    def teardown(self):
        if hasattr(self, "writer"):
            for observed in (self.lossless, *self.latest):
                observed.reader.close()
            self.writer.close()


Ring.TestCase.settings = settings(max_examples=40, stateful_step_count=40, deadline=None)
TestRing = Ring.TestCase
