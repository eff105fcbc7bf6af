"""One example of every message, and the bytes they are on the wire: run as a program, it writes them down anew."""

import json
from pathlib import Path

import acquire.replies as a
import acquire.requests as q
from acquire.messages import Header, encode

GOLDEN = Path(__file__).with_name("messages-1.json")
RUN = a.RunView(
    number=2,
    name="wing",
    folder="/data/wing-001",
    state="HOLD",
    phase="waiting",
    section=3,
    sections=50,
    plane=7,
    planned=600,
    taken=43,
    durable=42,
    missed=1,
    pausing="section",
    question=a.Question(
        code="debris", words="Debris. Sweep again?", answers={"sweep": "sweep once more", "end": "end the run"}
    ),
    left_s=81.5,
    error=a.Failed(code="limit", what="too far."),
    warnings=("focus is late.",),
)
STATE = a.State(
    state="HOLD",
    z_um=-2.5,
    z_age_s=0.25,
    live=True,
    exposure_ms=10.0,
    ring="/dev/shm/stereotome-1-run-2.ring",
    camera="512 x 512 uint16",
    holder="ann",
    stopped=False,
    run=RUN,
    feed=a.FeedView(state="ready", depth_nm=1400.0, knife="clear", cuts=3),
    utc_ns=1_795_645_701_337_418_803,
    why_stopped="it stood still.",
)
EVENT = a.Event(event={"event": "plane", "plane": 7, "z_um": -2.5})
PREVIEW = a.Preview(
    jpeg=b"\xff\xd8", number=9, section=3, plane=7, z_um=-2.5, shape=(512, 512), black=10, white=4000, utc_ns=5
)
MESSAGES = [
    Header(client="c" * 24, number=7, epoch="e", key="k", lease="l", wait_ms=500),
    q.Hello(),
    q.GetState(),
    q.GetInstrument(),
    q.GetValues(),
    q.TakeLease(actor="ann"),
    q.KeepLease(),
    q.ReleaseLease(),
    q.Snap(),
    q.StartLive(frames_per_s=12.0),
    q.StopLive(),
    q.SetCamera(exposure_ms=2.5, roi=(0, 16, 64, 32)),
    q.MoveStage(z_um=12.5, expect_state="IDLE"),
    q.JogStage(by_um=-0.5),
    q.ZeroStage(),
    q.ApproachSection(depth_um=100.0),
    q.HomeFeed(),
    q.RetractKnife(),
    q.FeedSection(thickness_nm=70.0, expect_section=3),
    q.ArmKnife(),
    q.CutSection(expect_section=3),
    q.PlanRun(recipe="schema = 1", overrides=("stack.step=1",)),
    q.StartRun(recipe="schema = 1", name="r.toml", overrides=("stack.step=1",), out="/data/x"),
    q.ContinueRun(folder="/data/x"),
    q.PauseRun(scope="before_cut"),
    q.ResumeRun(),
    q.CancelRun(),
    q.AnswerRun(choice="sweep"),
    q.NoteRun(text="wiped the face"),
    q.ClearStop(),
    q.Stop(),
    a.Welcome(instrument="bench-2", epoch="e", program="0.1.0", pid=42, stage_limits_um=(-200.0, 200.0)),
    a.Lease(token="t", lasts_s=3.0),
    a.Done(),
    a.Working(),
    a.Failed(code="limit", what="too far.", why="because", fix=("less",), exit_code=5),
    a.Position(z_um=12.5),
    a.Depth(depth_nm=1400.0, cuts=3),
    a.Picture(shape=(1, 2), dtype="uint16", pixels=b"\x01\x02\x03\x04", z_um=1.0, exposure_ms=2.5, utc_ns=5),
    a.Started(number=2, folder="/data/x", planned=21),
    a.InstrumentView(tables={"name": "bench-2", "optics": {"na": 0.45}}),
    a.Planned(
        folder="/data/x",
        planes=21,
        sections=1,
        planes_each=21,
        first_um=-10.0,
        last_um=10.0,
        step_um=1.0,
        seconds=3.5,
        dose_s=0.21,
        bytes_on_disk=11_010_048,
        needed_bytes=1_011_560_550,
        free_bytes=5_000_000_000,
    ),
    a.Stopped(told=("z stage",), failed=("feed: no answer",)),
    RUN,
    RUN.question,
    STATE.feed,
    STATE,
    EVENT,
    PREVIEW,
    a.Values(values={"state": (4, STATE), "run": (2, EVENT)}),
    a.Telling(4, EVENT),
]

if __name__ == "__main__":
    GOLDEN.write_text(json.dumps({type(each).__name__: encode(each).hex() for each in MESSAGES}, indent=1) + "\n")
