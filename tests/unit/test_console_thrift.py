"""How often the console draws during a run: its share of the processor, whatever a frame costs."""

import pytest

from display.console.thrift import FULL_HZ, LEAST_HZ, SHARE, Thrift


def rate_hz(frame_s, frames=60):
    """Return the rate after frames that took ``frame_s`` each."""
    spent = [k * frame_s for k in range(frames + 1)]
    thrift = Thrift(lambda: spent.pop(0))
    return [thrift.rate_hz() for _ in range(frames)][-1]


@pytest.mark.parametrize("frame_s", [0.01, 0.02, 0.04])
def test_frames_that_cost_much_are_drawn_so_often_that_they_keep_to_their_share(frame_s):
    assert rate_hz(frame_s) * frame_s == pytest.approx(SHARE, rel=0.01)


def test_cheap_frames_are_all_drawn_and_dear_ones_now_and_then():
    assert rate_hz(0.003) == FULL_HZ
    assert rate_hz(0.0) == FULL_HZ
    assert rate_hz(1.0) == LEAST_HZ
