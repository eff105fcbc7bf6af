"""What each camera does on its own, and what is said when it cannot."""

from __future__ import annotations

import socket
import threading
from contextlib import suppress
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st

from devices.clock import SystemClock
from devices.drivers import folder_camera, opencv_camera, sim_camera
from devices.errors import CameraTimeout, DeviceError, InputError, LimitError, LinkLost, RigError, StereotomeError
from devices.registry import DeviceContext
from devices.rig import CameraSpec
from devices.transport.json_lines import JsonLines

if TYPE_CHECKING:
    from pathlib import Path

    from devices.values import FrameStamp


class Bench:
    """Stands in for the wire to a bench: answers by a function, keeps what was asked."""

    def __init__(self, answer) -> None:
        self.answer = answer
        self.asked: list[dict] = []
        self.closed = False
        self.queue: list[dict] = []

    def send(self, message: dict) -> None:
        self.asked.append(message)
        self.queue += self.answer(message)

    def receive(self, wait_s: float) -> dict | None:
        return self.queue.pop(0) if self.queue else None

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def frames(tmp_path: Path) -> dict:
    (tmp_path / "frames").write_bytes(np.arange(2 * 12, dtype=np.uint16).tobytes())
    return {"path": str(tmp_path / "frames"), "slots": 2, "offset_bytes": 0, "stride_bytes": 24}


CAPS = {"name": "small", "height": 3, "width": 4, "bands": 1, "dtype": "uint16", "bit_depth": 12}


class TickingClock:
    """Each look at it costs a tenth of a second: waiting ends without anybody waiting."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def now(self) -> float:
        self.seconds += 0.1
        return self.seconds

    def sleep(self, seconds: float) -> None:
        self.seconds += seconds


def test_a_frame_is_a_read_only_view_of_its_slot(frames: dict):
    def answer(ask: dict) -> list[dict]:
        times = {"slot": 1, "hw_id": 17, "exposure_start_ns": 5, "exposure_end_ns": 6}
        late = [{"id": ask["id"] - 1, "ok": True, "slot": 0}]
        return [*late, {"id": ask["id"], "ok": True, "caps": CAPS, "frames": frames, **times}]

    camera = sim_camera.SimCamera(Bench(answer), TickingClock())
    seen = []
    camera.arm(1, lambda pixels, stamp: seen.append((pixels, stamp)))
    camera.trigger()
    pixels, stamp = seen[0]
    np.testing.assert_array_equal(pixels, np.arange(12, 24).reshape(3, 4))
    assert not pixels.flags.writeable
    assert (stamp.hw_id, stamp.exposure_start_ns, stamp.exposure_end_ns) == (17, 5, 6)
    with pytest.raises(DeviceError, match="without being armed"):
        camera.trigger()


def test_a_frame_that_never_comes_is_waited_for_five_exposures(frames: dict):
    def answer(ask: dict) -> list[dict]:
        return [{"id": ask["id"], "ok": True, "caps": CAPS, "frames": frames}] if ask["do"] != "trigger" else []

    clock = TickingClock()
    camera = sim_camera.SimCamera(Bench(answer), clock)
    for exposure_ms, timeout_s in ((10.0, 1.0), (2000.0, 10.0)):
        camera.configure(exposure_ms=exposure_ms)
        camera.arm(None, lambda pixels, stamp: None)
        before = clock.seconds
        with pytest.raises(StereotomeError) as caught:
            camera.trigger()
        assert caught.value.code == "camera-timeout"
        assert clock.seconds - before == pytest.approx(timeout_s, abs=0.3)


@pytest.mark.parametrize(
    ("answer", "code"),
    [
        ({"ok": False, "error": "busy"}, "device-busy"),
        ({"ok": False, "error": "no light"}, "device-failed"),
        ({"ok": True}, "device-garbled"),
        ({"ok": True, "caps": CAPS | {"dtype": "float64"}, "frames": {}}, "device-garbled"),
        ({"ok": True, "caps": CAPS, "frames": {"path": "/no/such", "slots": 1}}, "device-garbled"),
        ({"ok": True, "caps": CAPS | {"height": 5000}, "frames": None}, "device-garbled"),
    ],
)
def test_a_bench_that_is_busy_or_makes_no_sense(frames: dict, answer: dict, code: str):
    if answer.get("frames", 0) is None:
        answer = answer | {"frames": frames}
    with pytest.raises(DeviceError) as caught:
        sim_camera.SimCamera(Bench(lambda ask: [answer]), TickingClock())
    assert caught.value.code == code


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=2) | st.dictionaries(st.sampled_from(sorted(CAPS)), inner, max_size=3),
)


@given(st.data())
def test_whatever_a_bench_answers_is_a_frame_or_an_error_of_ours(data: st.DataObject):
    spoilt = data.draw(st.sampled_from(["caps", "frames", "slot", "hw_id", "exposure_end_ns", "id", "ok", "height"]))
    value = data.draw(JSON)
    frames = {"path": __file__, "slots": 2, "offset_bytes": 0, "stride_bytes": 24}
    caps = CAPS | ({"height": value} if spoilt == "height" else {})
    times = {"slot": 1, "hw_id": 17, "exposure_start_ns": 5, "exposure_end_ns": 6}

    def answer(ask: dict) -> list[dict]:
        good = {"id": ask["id"], "ok": True, "caps": caps, "frames": frames, **times}
        return [good | ({} if spoilt == "height" else {spoilt: value})]

    with suppress(StereotomeError):
        camera = sim_camera.SimCamera(Bench(answer), TickingClock())
        camera.configure(exposure_ms=5.0)
        camera.arm(1, lambda pixels, stamp: None)
        camera.trigger()


def test_no_address_and_nobody_there():
    with pytest.raises(RigError, match="needs the address"):
        sim_camera.open_camera(CameraSpec(driver="sim"), DeviceContext(SystemClock()))
    with pytest.raises(RigError, match="is no address"):
        JsonLines("nowhere", device="camera")
    with pytest.raises(DeviceError) as caught:
        JsonLines("127.0.0.1:1", device="camera")
    assert caught.value.code == "device-missing"


def served(*replies: bytes) -> str:
    """Answer one connection with fixed bytes, then close; return the address."""
    listener = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        peer = listener.accept()[0]
        peer.recv(1000)
        for reply in replies:
            peer.sendall(reply)
        peer.close()
        listener.close()

    threading.Thread(target=serve).start()
    return f"127.0.0.1:{listener.getsockname()[1]}"


def test_a_line_may_come_in_pieces_and_the_end_of_the_peer_is_noticed():
    wire = JsonLines(served(b'{"id":', b" 1}\n{", b'"id": 2}\nnonsense\n'), device="camera")
    wire.send({"id": 1})
    assert wire.receive(5.0) == {"id": 1}
    assert wire.receive(5.0) == {"id": 2}
    with pytest.raises(StereotomeError, match="no JSON object"):
        wire.receive(5.0)
    with pytest.raises(LinkLost):
        wire.receive(5.0)
    wire.close()


def folder_of(source: Path, z_um: float = 0.0, **changes: object) -> folder_camera.FolderCamera:
    spec = CameraSpec(driver="folder", source=str(source), **({"z0_um": 10.0, "step_um": -2.0} | changes))
    return folder_camera.open_camera(spec, DeviceContext(SystemClock(), None, lambda: z_um))


def taken(camera: folder_camera.FolderCamera) -> np.ndarray:
    seen: list[np.ndarray] = []
    camera.arm(1, lambda pixels, stamp: seen.append(pixels))
    camera.trigger()
    return seen[0]


@pytest.mark.parametrize(("z_um", "image"), [(10.0, 0), (9.1, 0), (8.9, 1), (-10.9, 10)])
def test_the_image_nearest_to_the_stage_is_taken_in_natural_order(tmp_path: Path, z_um: float, image: int):
    for number in range(11):
        cv2.imwrite(str(tmp_path / f"z{number}.png"), np.full((4, 5), number, np.uint8))
    assert taken(folder_of(tmp_path, z_um)).max() == image


@pytest.mark.parametrize("z_um", [11.1, -11.1])
def test_where_there_is_no_image(tmp_path: Path, z_um: float):
    for number in range(11):
        cv2.imwrite(str(tmp_path / f"z{number}.png"), np.zeros((4, 5), np.uint8))
    with pytest.raises(DeviceError, match="the 11 images stand for 10 … -10 µm") as caught:
        taken(folder_of(tmp_path, z_um))
    assert caught.value.code == "no-image"


def test_pixels_come_as_they_were_written(tmp_path: Path):
    noise = np.random.default_rng(1)
    colour = noise.integers(0, 65535, (7, 9, 3), np.uint16)
    grey = noise.integers(0, 255, (7, 9), np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), np.ascontiguousarray(colour[:, :, ::-1]))
    tifffile.imwrite(tmp_path / "b.tif", colour, photometric="rgb", planarconfig="contig")
    np.testing.assert_array_equal(taken(folder_of(tmp_path, 10.0)), colour)
    np.testing.assert_array_equal(taken(folder_of(tmp_path, 8.0)), colour)
    cv2.imwrite(str(tmp_path / "grey.jpg"), grey)
    (tmp_path / "a.png").unlink()
    (tmp_path / "b.tif").unlink()
    exact = cv2.imread(str(tmp_path / "grey.jpg"), cv2.IMREAD_UNCHANGED)
    camera = folder_of(tmp_path, 10.0)
    np.testing.assert_array_equal(taken(camera), exact)
    assert camera.caps().bands == 1


def test_the_pages_of_a_tiff_are_planes(tmp_path: Path):
    planes = np.arange(3 * 4 * 5, dtype=np.uint16).reshape(3, 4, 5)
    tifffile.imwrite(tmp_path / "stack.tif", planes, photometric="minisblack")
    camera = folder_of(tmp_path / "stack.tif", 6.0, bit_depth=12)
    np.testing.assert_array_equal(taken(camera), np.arange(40, 60).reshape(4, 5))
    assert (camera.caps().dtype, camera.caps().bit_depth) == ("uint16", 12)


def cut_off(name: str, keep: float):
    def spoil(folder: Path) -> None:
        data = (folder / name).read_bytes()
        (folder / name).write_bytes(data[: int(len(data) * keep)])

    return spoil


def preview_in_front_of_half(file: Path) -> None:
    """What a camera writes: a whole small JPEG inside the header of a large one, here cut off."""
    data = file.read_bytes()
    whole = cv2.imencode(".jpg", NOISE[::4, ::4])[1].tobytes()
    header = b"\xff\xe1" + (len(whole) + 2).to_bytes(2, "big") + whole
    file.write_bytes((data[:2] + header + data[2:])[: len(header) + len(data) // 2])


def another(name: str, image: np.ndarray):
    return lambda folder: tifffile.imwrite(folder / name, image)


NOISE = np.random.default_rng(2).integers(0, 255, (40, 50), np.uint8)


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (cut_off("z1.png", 0.6), "z1.png: cannot be read as an image: the file is cut off"),
        (cut_off("z2.jpg", 0.6), "z2.jpg: cannot be read as an image: the file is cut off"),
        (lambda folder: preview_in_front_of_half(folder / "z2.jpg"), "z2.jpg: cannot be read as an image: the file is"),
        (cut_off("z3.tif", 0.6), "z3.tif: cannot be read as an image"),
        (cut_off("z3.tif", 0.0), "z3.tif: cannot be read as TIFF"),
        (cut_off("z1.png", 0.0), "z1.png: cannot be read as an image"),
        (another("z4.tif", NOISE[:30]), "z4.tif: 50 x 30 px grey uint8, but"),
        (another("z4.tif", NOISE.astype(np.uint16)), "z4.tif: 50 x 40 px grey uint16, but"),
        (another("z4.tif", NOISE.astype(np.float32)), "z4.tif: (40, 50) float32 is no camera frame"),
        (another("z4.tif", np.stack([NOISE] * 5)), "z4.tif: cannot be read as an image: it holds 5 pages"),
    ],
)
def test_an_image_that_does_not_fit_is_named_before_anything_moves(tmp_path: Path, spoil, words: str):
    for name in ("z1.png", "z2.jpg"):
        cv2.imwrite(str(tmp_path / name), NOISE)
    tifffile.imwrite(tmp_path / "z3.tif", NOISE)
    folder_of(tmp_path)
    spoil(tmp_path)
    with pytest.raises(InputError) as caught:
        folder_of(tmp_path)
    assert words in caught.value.what


def test_a_jpeg_with_something_behind_its_end_is_whole(tmp_path: Path):
    cv2.imwrite(str(tmp_path / "z.jpg"), NOISE)
    whole = (tmp_path / "z.jpg").read_bytes()
    (tmp_path / "z.jpg").write_bytes(whole + b"\0" * 9000)
    assert taken(folder_of(tmp_path, 10.0)).shape == NOISE.shape


def test_a_folder_that_is_empty_missing_or_not_as_the_file_says(tmp_path: Path):
    with pytest.raises(InputError, match="holds no PNG, JPEG or TIFF"):
        folder_of(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        folder_of(tmp_path / "none")
    cv2.imwrite(str(tmp_path / "z1.png"), NOISE)
    with pytest.raises(RigError, match=r"size_px is \[40, 50\], but the images are 50 x 40 px"):
        folder_of(tmp_path, size_px=(40, 50))
    with pytest.raises(RigError, match="step_um"):
        folder_of(tmp_path, step_um=0.0)


def test_a_source_opencv_cannot_open(tmp_path: Path, capfd: pytest.CaptureFixture):
    for source in (str(tmp_path / "none%03d.tif"), "77", str(tmp_path / "none.avi")):
        with pytest.raises(DeviceError) as caught:
            opencv_camera.open_camera(CameraSpec(driver="opencv", source=source), DeviceContext(SystemClock()))
        assert caught.value.code == "device-missing"
    assert capfd.readouterr().err == "", "OpenCV talks over our error"


def test_a_free_running_camera_that_goes_says_so(tmp_path: Path):
    for number in range(3):
        tifffile.imwrite(tmp_path / f"z{number}.tif", NOISE)
    spec = CameraSpec(driver="opencv", source=str(tmp_path / "z%d.tif"), exposure_ms=0.01)
    camera = opencv_camera.open_camera(spec, DeviceContext(SystemClock()))
    seen = []
    camera.arm(None, lambda pixels, stamp: seen.append(stamp))
    camera._thread.join(10)
    with pytest.raises(LinkLost, match="gave no more frames after 3"):
        camera.trigger()
    camera.close()
    assert len(seen) == 3


def test_a_size_the_camera_does_not_have(tmp_path: Path):
    tifffile.imwrite(tmp_path / "z0.tif", NOISE)
    spec = CameraSpec(driver="opencv", source=str(tmp_path / "z%d.tif"), size_px=(640, 480))
    with pytest.raises(RigError, match=r"gives 50 x 40 px, but size_px is \[640, 480\]"):
        opencv_camera.open_camera(spec, DeviceContext(SystemClock()))


class UsbCamera:
    """Stands in for `cv2.VideoCapture` on a device: a picture each time it is let, then none."""

    settable = True

    def __init__(self, source: object) -> None:
        self.source = source
        self.values: dict[int, float] = {}
        self.pictures = threading.Semaphore(1)
        self.gone = False

    def isOpened(self) -> bool:  # noqa: N802  OpenCV's name
        return True

    def read(self) -> tuple[bool, np.ndarray]:
        self.pictures.acquire()
        return not self.gone, np.full((4, 5, 3), (1, 2, 3), np.uint8)

    def set(self, name: int, value: float) -> bool:
        self.values[name] = value
        return self.settable

    def get(self, name: int) -> float:
        return {cv2.CAP_PROP_FPS: 25.0}.get(name, 0.0)

    def release(self) -> None: ...


@pytest.fixture
def usb(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(cv2, "VideoCapture", UsbCamera)
    spec = CameraSpec(driver="opencv", source="3", size_px=(5, 4))
    camera = opencv_camera.open_camera(spec, DeviceContext(SystemClock()))
    yield camera, camera._capture
    camera._capture.pictures.release(9)
    camera.close()


def test_a_usb_camera_is_set_up_by_hand_and_says_what_it_cannot_tell(usb: tuple):
    camera, capture = usb
    camera.configure(exposure_ms=20.0)
    assert capture.source == 3
    assert capture.values[cv2.CAP_PROP_AUTO_EXPOSURE] == 1
    assert capture.values[cv2.CAP_PROP_EXPOSURE] == 200
    caps = camera.caps()
    assert (caps.timed, caps.buffered_frames, caps.readout_ms, caps.shape) == (False, 4, 40.0, (4, 5, 3))
    capture.settable = False
    with pytest.raises(LimitError, match="does not let its exposure be set to 20 ms"):
        camera.configure(exposure_ms=20.0)


def test_a_usb_camera_delivers_rgb_and_its_loss_is_told(usb: tuple):
    camera, capture = usb
    seen = []

    def lose_it(pixels: np.ndarray, stamp: FrameStamp) -> None:
        seen.append((pixels[0, 0].tolist(), stamp.exposure_start_ns))
        capture.gone = True
        capture.pictures.release()

    camera.arm(None, lose_it)
    capture.pictures.release()
    camera._thread.join(10)
    assert seen == [([3, 2, 1], None)]
    with pytest.raises(LinkLost, match="gave no more frames"):
        camera.trigger()


def test_a_usb_camera_whose_driver_hangs_does_not_hang_us(usb: tuple):
    camera, capture = usb
    camera.arm(None, lambda pixels, stamp: None)
    with pytest.raises(CameraTimeout, match="did not stop within"):
        camera.stop(0.01)
    capture.pictures.release()
    camera.stop(10.0)
