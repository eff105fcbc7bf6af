"""What the console knows and does, without a window: pure functions, and the model over an instrument that is faked."""

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from acquire import replies, requests
from acquire.recipe import recipe_from_text
from devices.errors import LimitError, PlanError, StageStalled, StereotomeError
from display.console import alarms
from display.console import contrast as grey
from display.console import placing as p
from display.console import settings as remembered
from display.console.drawn import Drawn, Wish
from display.console.eyes import histogram_of, look
from display.console.files import FileEditor
from display.console.journal import Journal, event_words
from display.console.keys import BINDINGS
from display.console.model import Console
from display.console.moving import Jogger, Marks
from display.console.run_queue import RunQueue, queue_file
from display.console.stack_form import Advice, SectionsForm, StackForm, form_of
from display.console.tour import STEPS, Tour
from display.controls import Shown
from display.relief import Relief
from display.scene import Layer, Scene
from processing.heights import Heights


def histogram(pixels, top=4095):
    return look(1, np.asarray(pixels, np.uint16), None, top).histogram


def test_limits_leave_out_no_more_than_is_ignored():
    rng = np.random.default_rng(3)
    pixels = np.clip(rng.normal(2000, 300, (200, 200)), 0, 4095)
    low, high = grey.spread(histogram(pixels), 1.0)
    width = 4096 / 256
    assert np.mean(pixels < low - width) <= 0.01 <= np.mean(pixels < low + width)
    assert np.mean(pixels > high + width) <= 0.01 <= np.mean(pixels > high - width)


def test_shares_at_the_ends_count_every_pixel():
    pixels = np.full((10, 10), 100, np.uint16)
    pixels[0, :3], pixels[1, :2] = 4095, 0
    seen = look(1, pixels, None, 4095)
    assert (seen.over, seen.under, seen.histogram.counts.sum()) == (0.03, 0.02, 100)


@given(st.floats(-1e4, 1e4), st.sampled_from(["low", "high"]))
def test_dragged_ends_never_pass_each_other_nor_leave_the_scale(level, end):
    made = grey.dragged(grey.Contrast(1000, 2000, auto="continuous"), end, level, 4095)
    assert 0 <= made.low < made.high <= 4095
    assert made.auto == "off"


@given(
    st.tuples(st.integers(1, 4000), st.integers(1, 4000)),
    st.tuples(st.floats(10, 3000), st.floats(10, 3000)),
    st.floats(-4, 9),
    st.floats(0, 1),
    st.floats(0, 1),
)
def test_what_is_under_the_mouse_stays_there_when_it_is_enlarged(picture, panel, steps, x, y):
    before = p.fit(picture, panel, p.Placing(2.0, 0.4, 0.6))
    at = before.place_of(x * picture[0], y * picture[1])
    placing = p.zoomed(p.Placing(2.0, 0.4, 0.6), steps, at, before, panel)
    after = p.fit(picture, panel, placing)
    if placing.zoom > 1 and 0 < placing.x < 1 and 0 < placing.y < 1:
        assert after.place_of(x * picture[0], y * picture[1]) == pytest.approx(at, abs=1e-6 * max(panel))


@given(st.floats(1e-4, 1e3), st.floats(50, 4000))
def test_a_scale_bar_is_round_and_fits(um, width):
    length_um, length = p.scale_bar(um, width)
    assert length <= width / 4 * (1 + 1e-9)
    assert length > width / 4 / 2.6
    assert f"{length_um:e}"[0] in "125" or f"{length_um:.0e}"[0] in "125"


def test_wishes_to_move_add_up_while_a_move_is_under_way():
    jogger = Jogger(chosen=1)
    jogger.jog(1)
    assert jogger.due_um() == 0.5
    jogger.jog(2)
    jogger.jog(1, faster=True)
    assert jogger.due_um() == 0
    jogger.done()
    assert jogger.due_um() == 6.0


@given(
    st.sampled_from(["planes", "step", "nyquist", "dof"]),
    st.booleans(),
    st.text("abc \"'\\µ\n", max_size=20),
    st.integers(2, 500),
    st.floats(0.01, 50),
)
def test_every_form_makes_a_recipe(spacing, marked, notes, planes, step_um):
    marks = Marks(top_um=-3.0, bottom_um=4.0) if marked else Marks()
    form = StackForm(notes=notes, marks=marks, spacing=spacing, planes=planes, step_um=step_um)
    recipe = recipe_from_text(form.recipe(), "form")
    assert recipe.notes == notes
    assert recipe.stack.range_um(0.0) == ((-3.0, 4.0) if marked else (-10.0, 10.0))
    sections = StackForm(marks=marks, sections=SectionsForm(wanted=True, count=3, thickness="70"))
    assert recipe_from_text(sections.recipe(), "form").sections.sections == 3
    assert "process" not in tomllib.loads(sections.recipe())


@given(
    st.builds(
        StackForm,
        name=st.text("ab é", max_size=9),
        marks=st.sampled_from([Marks(), Marks(top_um=1.5, bottom_um=-2.0)]),
        around_um=st.floats(0.01, 500),
        spacing=st.sampled_from(["planes", "step", "nyquist", "dof"]),
        planes=st.integers(2, 999),
        step_um=st.floats(0.001, 50),
        direction=st.sampled_from(["up", "down"]),
        return_to=st.sampled_from(["start", "middle", "park", "stay"]),
        exposure_ms=st.none() | st.floats(0.1, 100),
        focus=st.booleans(),
        stereo=st.booleans(),
        keep_free_gb=st.floats(0, 9),
        notify=st.sampled_from(["", "echo 'two words'"]),
        sections=st.builds(
            SectionsForm,
            wanted=st.booleans(),
            by_depth=st.booleans(),
            count=st.integers(3, 99),
            depth_um=st.floats(1, 99),
            thickness=st.floats(10, 900).map("{:.1f}".format) | st.just("1: 100, 2-: 50"),
            cut_first=st.booleans(),
            sweeps=st.integers(0, 10),
            on_quality=st.sampled_from(["pause", "accept"]),
            on_error=st.sampled_from(["pause", "park-and-stop", "continue"]),
        ),
    )
)
def test_a_form_made_of_a_recipe_makes_that_recipe(form):
    assert form_of(form.recipe()).recipe() == form.recipe()


@pytest.mark.parametrize(
    ("more", "lacking"),
    [
        ('bands = ["red"]', "stack.bands"),
        ('trigger = "hardware"\n[series]\ncount = 3', "stack.trigger, series"),
        ('[output]\ncompression = "zstd"', "output.compression"),
        ("[process]\nrange_image = true", "process.range_image"),
    ],
)
def test_a_recipe_beyond_the_form_is_refused_and_the_form_stays(console, more, lacking):
    form = console.form
    words = console.fill_form(f"[stack]\naround_um = 4\nplanes = 3\n{more}\n")
    assert f"no field for {lacking}. The form is as it was." in words
    assert console.form is form
    assert "no field for stack.positions_um." in console.fill_form("[stack]\npositions_um = [0.0, 1.0, 5.0]\n")
    assert "give top_um and bottom_um" in console.fill_form("[stack]")
    assert console.form is form


def test_thickness_by_ranges_of_cuts_is_counted_as_the_run_counts_it():
    form = SectionsForm(wanted=True, by_depth=True, depth_um=2.3, thickness="1-10: 100, 11-: 50")
    assert (form.number, form.total_um, form.first_nm) == (36, 2.3, 100)
    assert form.table()["thickness_nm"] == "1-10: 100, 11-: 50"
    made = StackForm(marks=Marks(2.0, -2.0), sections=replace(form, thickness="1-10: 100, 12-: 50"))
    with pytest.raises(ValueError, match="cut 11 is in no range"):
        _ = made.sections.number
    with pytest.raises(PlanError, match="cut 11 is in no range"):
        recipe_from_text(made.recipe(), "form")


def test_a_recipe_goes_into_the_form(console):
    text = "[stack]\ntop_um = 3\nbottom_um = -1\nstep = 0.5\n[sections]\ndepth_um = 2\nthickness_nm = 100\n"
    assert "in the form" in console.fill_form(text)
    assert (console.form.marks.top_um, console.form.step_um, console.form.sections.number) == (3, 0.5, 20)


def test_overlap_is_that_of_depths_of_field():
    assert Advice(0.8, 1.0).overlap_percent(0.25) == 75
    assert Advice(0.8, 1.0).overlap_percent(-2.0) == 0


def test_no_unmodified_letter_moves_hardware():
    moving = ("stage", "go to ", "start")
    for binding in BINDINGS:
        if len(binding.shown) == 1 and binding.shown.isalpha():
            assert not any(word in binding.words for word in moving), binding
    assert len({(binding.key, binding.ctrl) for binding in BINDINGS}) == len(BINDINGS)


def test_settings_come_back_and_a_damaged_file_is_left_aside(tmp_path):
    remembered.save(tmp_path, replace(remembered.Settings(), table="viridis", jog=1))
    assert remembered.load(tmp_path).table == "viridis"
    (tmp_path / remembered.NAME).write_text('{"table": 5, "gamma": 2, "jog": "x", "other": 1}')
    assert remembered.load(tmp_path) == replace(remembered.Settings(), gamma=2)
    (tmp_path / remembered.NAME).write_text("[")
    assert remembered.load(tmp_path) == remembered.Settings()


def test_events_come_in_words_and_planes_do_not():
    assert event_words({"event": "plane", "plane": 3}) is None
    assert event_words({"event": "hold", "question": "Debris?"}) == ("warning", "HOLD: Debris?")
    assert event_words({"event": "done", "state": "COMPLETED", "folder": "/d"})[0] == "info"


class FakeBench:
    """Answers nothing by itself; says what it was asked."""

    def __init__(self):
        self.connected, self.commands, self.stop_asked, self.rig, self.actor = True, True, False, None, "ann"
        self.asked, self.stops = [], 0
        self.state = replies.State(
            state="IDLE",
            z_um=1.0,
            z_age_s=0.0,
            live=False,
            exposure_ms=2.0,
            ring="",
            camera="",
            holder="ann",
            stopped=False,
        )

    def ask(self, request, place, answered=None, *, quiet=False):
        self.asked.append((request, answered))

    def stop(self):
        self.stops += 1
        self.stop_asked = True

    def settle(self):
        pass


class Ticking:
    """A clock that goes on by a second at every look."""

    def __init__(self):
        self.s = 0.0

    def now(self):
        self.s += 1.0
        return self.s


class FakeEyes:
    seen = None
    kept = None
    afar = False


@pytest.fixture
def console():
    return Console(FakeBench(), FakeEyes(), Journal(), remembered.Settings(), Ticking())


PLANNED = replies.Planned(
    folder="/d", planes=21, sections=1, planes_each=21, first_um=0, last_um=20, step_um=1, seconds=9, dose_s=1,
    bytes_on_disk=10, needed_bytes=20, free_bytes=30,
)  # fmt: skip


def test_the_first_picture_of_all_is_kept_though_no_frame_was_seen_before(console, tmp_path):
    console.settings.snapshots = str(tmp_path)
    console.camera.snap()
    _, answered = console.bench.asked.pop()
    pixels = np.arange(12, dtype=np.uint16).reshape(3, 4)
    answered(replies.Picture(shape=(3, 4), dtype="uint16", pixels=pixels.tobytes(), z_um=1, exposure_ms=2, utc_ns=3))
    [kept] = tmp_path.glob("snap-*.tif")
    assert np.array_equal(tifffile.imread(kept), pixels)


def test_a_stop_forgets_what_was_wanted(console):
    console.jog(1)
    console.stop()
    console.tick()
    assert console.bench.stops == 1
    assert not any(isinstance(request, requests.JogStage) for request, _ in console.bench.asked)


def test_nothing_is_moved_while_it_must_not(console):
    console.bench.stop_asked = True
    console.jog(1)
    console.tick()
    assert "STOP" in console.notice
    console.go(3.0)
    assert all(isinstance(request, requests.PlanRun) for request, _ in console.bench.asked)


def test_a_refusal_is_told_beside_the_stage_and_ends_the_wish(console):
    console.jog(1)
    console.tick()
    request, answered = next(each for each in console.bench.asked if isinstance(each[0], requests.JogStage))
    assert request.by_um == 2.0
    console.jog(5)
    answered(LimitError("+900 µm is outside."))
    assert "outside" in console.notice
    assert console.jogger.due_um() == 0


def test_a_full_disk_or_a_wrong_plan_blocks_the_start(console):
    assert "being made" in console.why_no_start()
    console.planned = replace_planned(free_bytes=5)
    assert "disk" in console.why_no_start()
    console.planned = StereotomeError("no.", code="config")
    assert "[config]" in console.why_no_start()
    console.start_run()
    assert not any(isinstance(request, requests.StartRun) for request, _ in console.bench.asked)
    console.planned = PLANNED
    assert not console.why_no_start()
    console.start_run()
    assert isinstance(console.bench.asked[-1][0], requests.StartRun)


def replace_planned(**changed):
    import msgspec

    return msgspec.structs.replace(PLANNED, **changed)


def test_marks_go_when_zero_moves(console):
    console.mark("top")
    assert console.form.marks.top_um == 1.0
    console.zero()
    assert console.form.marks == Marks()


def test_the_plan_is_asked_for_once_and_again_when_the_form_changes(console):
    for _ in range(3):
        console.tick()
    assert len(console.bench.asked) == 1
    console.bench.asked[0][1](PLANNED)
    console.tick()
    console.form.planes = 9
    console.tick()
    assert [type(request) for request, _ in console.bench.asked] == [requests.PlanRun, requests.PlanRun]


def test_the_tour_starts_its_stack_once_it_is_planned_and_ends_after_its_last_step(console):
    console.tour = Tour("/demo")
    console.tick()
    assert not console.tour.started
    console.planned = replace_planned(planes=49)
    console.tick()
    console.tick()
    started = [request for request, _ in console.bench.asked if isinstance(request, requests.StartRun)]
    assert len(started) == 1
    recipe = recipe_from_text(started[0].recipe, "tour")
    assert (recipe.stack.planes, recipe.output.folder) == (49, "/demo/run-{run:03d}")
    for _ in STEPS:
        console.tour.forward()
    assert not console.tour.shown


def test_a_line_over_a_range_image_is_measured_in_um():
    rows, columns, pixel_um = 60, 80, 0.5
    heights = Heights(np.tile(0.5 * pixel_um * np.arange(columns), (rows, 1)).astype(np.float32), (pixel_um, pixel_um))
    wish = Wish("run", Shown(("range",), 1, mode="range"), (400, 300))
    drawn = Drawn(wish, np.zeros((300, 400, 3), np.uint8), Scene((Layer(Relief(heights), "isometric"),)))
    line = ((100, 150), (300, 150))
    length_um = drawn.length_um(line)
    assert length_um == pytest.approx(200 * drawn.pixel_um)
    assert drawn.pixel_um == pytest.approx(79 * pixel_um * 1.04 / 400)
    found = drawn.profile(line)
    assert found.distance[-1] == pytest.approx(length_um)
    assert found.height[-1] - found.height[0] == pytest.approx(0.5 * length_um, rel=1e-4)
    assert found.height[0] == pytest.approx(0.5 * (79 * pixel_um / 2 - length_um / 2), rel=1e-4)


def test_a_line_ends_where_the_data_end_and_moves_with_the_picture():
    heights = Heights(np.zeros((60, 80), np.float32), (0.5, 0.5))
    scene = Scene((Layer(Relief(heights), "isometric"),))
    drawn = Drawn(Wish("run", Shown(("range",), 1, mode="range"), (400, 300)), np.zeros((300, 400, 3), np.uint8), scene)
    across = ((-50, 150), (900, 150))
    assert drawn.length_um(across) == pytest.approx(Relief(heights).size_um[0])
    moved = replace(drawn, scene=replace(scene, view=replace(scene.view, centre_um=(3.0, 0.0, 0.0))))
    at = ((200, 150), (300, 150))
    np.testing.assert_allclose(moved.ends_um(at)[0] - drawn.ends_um(at)[0], (3.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(moved.ends_px(at), at)


def run_view(number, state):
    return replies.RunView(
        number=number, name="r", folder="/d", state=state, phase="", section=0, sections=1, plane=0, planned=3,
        taken=3, durable=3, missed=0,
    )  # fmt: skip


def told(console, run=None, state="IDLE", **changed):
    import msgspec

    console.bench.state = msgspec.structs.replace(console.bench.state, state=state, run=run, **changed)


def starts(console):
    return [(request.name, answered) for request, answered in console.bench.asked if type(request) is requests.StartRun]


def started(number):
    return replies.Started(number=number, folder="/d", planned=3)


def test_queued_runs_follow_each_other_and_stop_at_the_first_that_does_not_complete(console):
    for name in ("one", "two", "three"):
        console.queue.add(name, "text")
    console.tick()
    assert not starts(console)
    console.queue.move(2, -1)
    console.queue.go(console)
    for _ in range(3):
        console.tick()
    assert [name for name, _ in starts(console)] == ["one"]
    starts(console)[0][1](started(1))
    console.tick()  # its state is not told yet
    told(console, run_view(1, "RUNNING"), "RUNNING")
    console.tick()
    assert len(starts(console)) == 1
    told(console, run_view(1, "COMPLETED"))
    console.tick()
    assert [name for name, _ in starts(console)] == ["one", "three"]
    starts(console)[1][1](started(2))
    told(console, run_view(2, "CANCELLED"))
    for _ in range(3):
        console.tick()
    assert (len(starts(console)), [each.name for each in console.queue.waiting]) == (2, ["two"])
    assert "CANCELLED" in console.queue.held
    assert [line.place for line in console.alarms.unseen] == ["queue"]


def test_a_queue_waits_while_nothing_may_move_and_is_held_by_a_refusal(console):
    console.queue.add("one", "text")
    console.bench.stop_asked = True
    console.queue.go(console)
    console.tick()
    assert not starts(console)
    assert "STOP" in console.queue.held
    console.bench.stop_asked = False
    console.tick()
    starts(console)[0][1](StereotomeError("the disk is full.", code="disk-full"))
    console.tick()
    assert (len(starts(console)), console.queue.held, len(console.queue.waiting)) == (1, "the disk is full.", 1)


def test_what_waits_is_kept_for_the_next_console_and_goes_on_after_a_silence(tmp_path):
    file = queue_file(tmp_path, "a/b bench")
    before, after = RunQueue(), RunQueue()
    before.add("one", "text 1")
    before.keep(file)
    before.going = True
    before.leave()  # the instrument fell silent
    before.keep(file)
    assert before.going
    after.add("mine", "text 2")
    after.keep(file)
    assert [each.name for each in after.waiting] == ["one", "mine"]
    assert after.held
    assert not after.going
    before.leave()
    before.keep(file)  # back in command, after another console changed it
    assert (before.waiting, before.going) == (after.waiting, False)
    file.write_text('[{"name": 3}, 1')
    broken = RunQueue()
    broken.keep(file)
    assert not broken.waiting


def test_sections_by_depth_are_as_many_as_the_instrument_makes_of_it_and_a_command_is_told():
    form = StackForm(notify="notify-send 'a run' {event}")
    form.marks = Marks(top_um=1.0, bottom_um=0.0)
    form.sections = SectionsForm(wanted=True, by_depth=True, depth_um=1.4, thickness="70", on_error="park-and-stop")
    recipe = recipe_from_text(form.recipe(), "form")
    assert recipe.sections.sections == form.sections.number == 20
    assert recipe.sections.on_error == "park-and-stop"
    assert recipe.watch.notify.command == ("notify-send", "a run", "{event}")
    form.notify = "it's open"
    assert recipe_from_text(form.recipe(), "form").watch.notify.command == ("it's", "open")


def test_alarms_stay_until_they_are_seen_and_sound_once(console, monkeypatch):
    heard = []
    monkeypatch.setattr("display.console.model.sound", heard.append)
    console.journal.add("error", "stage", "[limit] outside")  # a person stands there
    console.journal.add("warning", "run", "HOLD: debris?")
    console.journal.add("error", "instrument", "fell silent")
    console.tick()
    console.tick()
    assert [line.words for line in console.alarms.unseen] == ["HOLD: debris?", "fell silent"]
    assert len(heard) == 1
    console.alarms_seen()
    assert console.shows_alarms
    assert console.alarms.unseen
    console.alarms_seen()
    assert not console.alarms.unseen
    console.settings.sound = False
    console.journal.add("warning", "run", "FAILED: /d")
    console.tick()
    assert (len(console.alarms.unseen), len(heard)) == (1, 1)


def test_the_sound_of_an_alarm_is_a_file_any_player_knows(tmp_path, monkeypatch):
    import wave

    played = []
    monkeypatch.setattr("shutil.which", lambda name: name if name == "aplay" else None)
    monkeypatch.setattr("subprocess.Popen", lambda command, **_: played.append(command))
    alarms.sound(tmp_path / "new" / "a.wav")
    assert played == [["aplay", str(tmp_path / "new" / "a.wav")]]
    with wave.open(played[0][1]) as file:
        assert 0.5 < file.getnframes() / file.getframerate() < 2


@given(
    st.tuples(st.integers(0, 500), st.integers(0, 500), st.integers(8, 900), st.integers(8, 900)),
    st.data(),
)
def test_a_part_of_the_frame_lies_in_it_whatever_was_chosen_before(frame, data):
    corner, other = (
        (data.draw(st.integers(0, frame[2] - 1)), data.draw(st.integers(0, frame[3] - 1))) for _ in range(2)
    )
    made = p.inside(frame, corner, other)
    if made is None:
        assert min(abs(a - b) for a, b in zip(corner, other, strict=True)) < 9
        return
    x, y, width, height = made
    assert frame[0] <= x <= x + width <= frame[0] + frame[2]
    assert frame[1] <= y <= y + height <= frame[1] + frame[3]
    assert min(width, height) >= 8
    assert width % 2 == height % 2 == 0


RECIPE = "schema = 1\n[stack]\ntop_um = 1.0\nbottom_um = -1.0\nplanes = 3\n"


def test_a_file_is_checked_as_the_command_line_does_and_only_a_good_one_is_written(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(RECIPE)
    files = FileEditor(str(path))
    files.open()
    assert (files.good, files.kind, files.changed) == (True, "recipe", False)
    files.text = RECIPE.replace("planes = 3", "plains = 3")
    files.save()
    assert not files.good
    assert "r.toml:5" in files.words
    assert "did you mean 'planes'?" in files.words
    assert path.read_text() == RECIPE
    files.text = RECIPE.replace("3", "5")
    files.save()
    assert (files.good, path.read_text()) == (True, files.text)
    path.write_text("# somebody else\n" + RECIPE)
    files.text = RECIPE.replace("3", "7")
    files.save()
    assert "changed meanwhile" in files.words
    assert path.read_text().startswith("# somebody")


def test_files_that_cannot_be_read_or_written_are_told(tmp_path):
    files = FileEditor(str(tmp_path / "none.toml"))
    files.open()
    assert "cannot be read" in files.words
    (tmp_path / "binary").write_bytes(b"\xff\xfe\x00")
    files.path = str(tmp_path / "binary")
    files.open()
    assert "cannot be read" in files.words
    files.begin(str(tmp_path / "no" / "folder.toml"), RECIPE)
    files.save()
    assert "not written" in files.words
    files.begin(str(tmp_path / "rig.toml"), (Path(__file__).parents[2] / "sim/default_instrument.toml").read_text())
    files.save()
    assert "next start" in files.words


def test_a_part_is_chosen_in_the_whole_frame_and_then_within_the_part(console):
    from devices.rig import load_rig

    console.bench.rig = load_rig(Path(__file__).parents[2] / "sim" / "default_instrument.toml")
    width, height = console.bench.rig.camera.size_px
    console.eyes = FakeEyes()
    console.eyes.seen = look(1, np.zeros((height, width), np.uint16), None, 4095)
    console.camera.choose_part((100, 60), (219, 139))
    assert console.bench.asked[-1][0].roi == (100, 60, 120, 80)
    console.eyes.seen = look(2, np.zeros((80, 120), np.uint16), None, 4095)
    console.camera.choose_part((39, 29), (10, 10))
    assert console.bench.asked[-1][0].roi == (110, 70, 30, 20)
    asked = len(console.bench.asked)
    console.eyes.seen = look(3, np.zeros((33, 44), np.uint16), None, 4095)  # chosen by somebody else
    console.camera.choose_part((0, 0), (20, 20))
    assert (len(console.bench.asked), "elsewhere" in console.notice) == (asked, True)
    console.camera.set_roi(None)
    assert console.bench.asked[-1][0].roi == (0, 0, width, height)


@pytest.mark.parametrize("top", [255, 4095, 65535])
def test_a_frame_of_one_level_is_white_only_at_full_scale(top):
    for level, shown in ((top, 1.0), (0, 0.0)):
        low, high = grey.spread(histogram_of(np.full((8, 8), level, np.uint16), top), 0.1)
        assert np.clip((level - low) / (high - low), 0, 1) == pytest.approx(shown, abs=0.01)
    assert grey.spread(grey.Histogram(np.eye(1, 256, 128, dtype=np.int64)[0], 255), 0.0) == (127, 129)


@pytest.mark.parametrize(
    ("dtype", "told", "top"), [("u1", 255, 255), ("u2", 4095, 4095), ("u2", 255, 65535), ("u1", 4095, 255)]
)
def test_frames_that_cannot_be_of_the_depth_in_the_file_are_not_called_saturated(dtype, told, top):
    seen = look(1, np.full((8, 8), min(top, 1500), dtype), None, told)
    assert seen.histogram.top == top
    assert seen.histogram.counts.sum() == 64
    assert seen.over == (top == 255)


def test_keys_choose_views_of_the_last_run_and_how_eyes_see_them(console):
    told(console, run=run_view(1, "COMPLETED"))
    keys = {binding.shown: binding.do for binding in BINDINGS}
    keys["3"](console)
    assert (console.front, console.viewing.folder, console.viewing.shown.mode) == ("Review", "/d", "range")
    keys["X"](console)
    assert console.viewing.shown.stereo.swap
    keys["1"](console)
    assert console.front == "Live"
    console.shows, console.viewing.size = "Review", (400, 300)
    keys["L"](console)
    assert console.viewing.line == ((0, 150), (399, 150))
    keys["4"](console)
    assert console.viewing.line is None


def test_a_move_that_stop_ended_is_told_so_and_no_longer_after_the_release(console):
    console.go(5.0)
    _, answered = console.bench.asked[-1]
    console.stop()
    answered(StageStalled("z stage: the move was halted; it is at +5 of +5."))
    assert console.notice == "STOP ended this move."
    console.release_stop()
    assert not console.notice
