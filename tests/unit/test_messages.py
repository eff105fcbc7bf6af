"""Messages: their bytes do not change within a major version, and no bytes at all break the reader."""

import importlib.util
import json
from pathlib import Path
from typing import get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from acquire import messages, replies, requests

SPEC = importlib.util.spec_from_file_location("golden", Path(__file__).parent.parent / "golden" / "messages.py")
golden = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(golden)

BYTES = json.loads(golden.GOLDEN.read_text())


@pytest.mark.parametrize("message", golden.MESSAGES, ids=lambda message: type(message).__name__)
def test_bytes_are_those_of_this_major_version(message):
    assert messages.encode(message).hex() == BYTES[type(message).__name__]
    assert msgspec.msgpack.decode(bytes.fromhex(BYTES[type(message).__name__]), type=type(message)) == message


def test_no_message_is_without_its_bytes():
    every = {*get_args(requests.AnyRequest), *get_args(replies.AnyReply), *get_args(replies.Told)}
    assert every - {type(message) for message in golden.MESSAGES} == set()
    assert {type(message).__name__ for message in golden.MESSAGES} == set(BYTES)


def test_a_reader_passes_over_what_a_later_minor_version_added():
    later = {"type": "move-stage", "z_um": 1.0, "gently": True}
    assert messages.decode_request(msgspec.msgpack.encode(later)) == requests.MoveStage(z_um=1.0)


def test_what_is_wrong_is_told_with_its_place():
    wrong = {"type": "move-stage", "z_um": "far"}
    with pytest.raises(msgspec.ValidationError, match=r"\$\.z_um"):
        messages.decode_request(msgspec.msgpack.encode(wrong))


@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(data):
    for decode in (messages.decode_header, messages.decode_request, messages.decode_reply, messages.unpack_telling):
        try:
            decode(data)
        except msgspec.DecodeError:
            continue


@given(st.sampled_from(golden.MESSAGES), st.data())
def test_any_damage_is_read_or_refused(message, data):
    raw = bytearray(messages.encode(message))
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(1, 255))
    test_any_bytes_are_read_or_refused.hypothesis.inner_test(bytes(raw))


@given(st.floats(), st.one_of(st.none(), st.integers(-(1 << 60), 1 << 60)))
def test_requests_come_back_as_they_were(z_um, section):
    sent = requests.MoveStage(z_um=z_um, expect_section=section)
    came = messages.decode_request(messages.encode(sent))
    assert (repr(came.z_um), came.expect_section) == (repr(z_um), section)
