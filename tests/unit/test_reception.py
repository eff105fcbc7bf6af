"""What comes in from the wires: garbage, foreigners, old lives and repetitions, before anything is carried out."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire import messages, replies, requests
from acquire.lease import LeaseBook
from acquire.reception import Door, Reception
from devices.errors import DeviceBusy
from devices.rig import RigSpec
from sim.clock import SimClock

KEY, EPOCH = "the word", "this life"
SPEC = RigSpec.model_validate(
    {
        "schema": 1,
        "name": "bench",
        "camera": {"driver": "sim"},
        "optics": {"magnification": 20.0, "na": 0.5},
        "stage": {"z": {"driver": "asi-ms2000", "port": "p", "limits": {"min_um": -1.0, "max_um": 1.0}}},
    }
)


class Bench:
    """Stands for the host: notes what it is given to carry out."""

    def __init__(self):
        self.carried_out = []
        self.full = False
        self.holder = None

    def put(self, request, wait_ms, answer):
        if self.full:
            raise DeviceBusy("full", code="serve-full")
        self.carried_out.append((request, wait_ms, answer))

    def held_by(self, holder):
        self.holder = holder


@pytest.fixture
def bench():
    return Bench()


@pytest.fixture
def desk(bench):
    delivered = []
    reception = Reception(
        bench,
        None,
        LeaseBook(SimClock()),
        spec=SPEC,
        door=Door(KEY, EPOCH),
        epoch=EPOCH,
        deliver=lambda *what: delivered.append(what),
    )
    reception.delivered = delivered
    return reception


def message(request, number=1, *, major=messages.MAJOR, client="c", key=KEY, epoch=EPOCH, lease=""):
    header = messages.Header(client=client, number=number, key=key, epoch=epoch, lease=lease)
    return [major, messages.encode(header), messages.encode(request)]


def answer(desk, *arguments, **options):
    frames = desk.receive(b"peer", message(*arguments, **options))
    return None if frames is None else messages.decode_reply(frames[2])


def lease_of(desk, number=1):
    return answer(desk, requests.TakeLease(actor="ann"), number).token


def test_hello_needs_no_epoch_and_tells_it(desk):
    welcome = answer(desk, requests.Hello(), epoch="")
    assert (welcome.epoch, welcome.instrument, welcome.stage_limits_um) == (EPOCH, "bench", (-1.0, 1.0))


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (message(requests.GetState(), major=b"ST2"), "serve-request"),
        (message(requests.GetState(), key="a guess"), "serve-keys"),
        (message(requests.Hello(), key=""), "serve-keys"),
        (message(requests.GetState(), epoch="the life before"), "serve-epoch"),
        (message(requests.GetState(), epoch=""), "serve-epoch"),
        ([messages.MAJOR, b"\xc1", b""], "serve-request"),
        ([*message(requests.Hello())[:2], b"\x80"], "serve-request"),
        ([*message(requests.Hello())[:2], msgspec.msgpack.encode({"type": "self-destruct"})], "serve-request"),
        (message(requests.Stop()), "serve-request"),
        (message(requests.MoveStage(z_um=1.0)), "lease-needed"),
        (message(requests.MoveStage(z_um=1.0), lease="x"), "lease-lost"),
    ],
)
def test_what_may_not_in_is_told_why_and_nothing_is_done(desk, bench, sent, code):
    _, _, reply = desk.receive(b"peer", sent)
    failed = messages.decode_reply(reply)
    assert failed.code == code
    assert "Nothing was done" in failed.what or code == "serve-keys"
    assert bench.carried_out == []


@pytest.mark.parametrize("frames", [[], [b""], [b"GET / HTTP/1.1\r\n"], [b"ST1"], [b"x", b"y", b"z"], [b"ST1"] * 9])
def test_what_is_not_ours_is_dropped(desk, frames):
    assert desk.receive(b"peer", frames) is None


@given(st.lists(st.binary(max_size=60), max_size=4), st.booleans())
def test_no_frames_at_all_break_it(frames, ours):
    bench = Bench()
    reception = Reception(
        bench, None, LeaseBook(SimClock()), spec=SPEC, door=Door(KEY, EPOCH), epoch=EPOCH, deliver=lambda *_: None
    )
    reception.receive(b"peer", [messages.MAJOR, *frames] if ours else frames)
    assert bench.carried_out == []


def test_a_lost_answer_is_given_again_and_nothing_is_done_twice(desk, bench):
    token = lease_of(desk)
    cut = requests.CutSection(expect_section=3)
    assert answer(desk, cut, 2, lease=token) is None
    assert answer(desk, cut, 2, lease=token) == replies.Working()
    assert len(bench.carried_out) == 1
    bench.carried_out[0][2](replies.Depth(depth_nm=1.0, cuts=4))
    ((sender, header, reply),) = desk.delivered
    assert sender == b"peer"
    frames = desk.finished(header, reply)
    assert messages.decode_reply(frames[2]) == replies.Depth(depth_nm=1.0, cuts=4)
    assert answer(desk, cut, 2, lease=token) == replies.Depth(depth_nm=1.0, cuts=4)
    assert len(bench.carried_out) == 1


def test_a_refusal_is_an_answer_too(desk, bench):
    move = requests.MoveStage(z_um=0.5)
    assert answer(desk, move, 1).code == "lease-needed"
    token = lease_of(desk, 2)
    assert answer(desk, move, 1, lease=token).code == "lease-needed"  # the same request, asked by another right
    assert bench.carried_out == []


def test_too_much_at_once_is_refused(desk, bench):
    bench.full = True
    assert answer(desk, requests.MoveStage(z_um=0.5), 2, lease=lease_of(desk)).code == "serve-full"


def test_the_bench_knows_who_commands(desk, bench):
    token = lease_of(desk)
    assert bench.holder == "ann"
    assert answer(desk, requests.KeepLease(), 2, lease=token) == replies.Done()
    assert answer(desk, requests.ReleaseLease(), 3, lease=token) == replies.Done()
    assert bench.holder == ""
