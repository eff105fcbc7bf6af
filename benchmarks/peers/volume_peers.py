"""Volumes, slices and shifted planes beside VTK and vispy: CPU time of the whole process for a frame, interleaved.

Peers are not locked: install vtk and vispy into an environment of their own and name its site-packages:
``STEREOTOME_PEERS=.../site-packages python benchmarks/peers/volume_peers.py [SIDE [FRAMES [ours,vtk,vispy]]]``
"""

from __future__ import annotations

import os
import sys
import time
from dataclasses import replace

import numpy as np

sys.path.append(os.environ.get("STEREOTOME_PEERS", ""))  # behind our own packages

from display.gl.renderer import Renderer
from display.scene import Band, Layer, Scene, SliceLook, Transfer, View, Volume, VolumeLook
from display.stereo import Stereo

SIDE = int(sys.argv[1]) if len(sys.argv) > 1 else 256
FRAMES = int(sys.argv[2]) if len(sys.argv) > 2 else 4
SIZE = (512, 512)
PEERS = sys.argv[3].split(",") if len(sys.argv) > 3 else ["ours", "vtk", "vispy"]
FLOOR, FULL = 12, 255
OPACITY = 0.05


def cells(side: int) -> np.ndarray:
    """Hollow shells over faint noise: most of it is empty."""
    rng = np.random.default_rng(0)
    volume = rng.integers(0, FLOOR, (side, side, side), np.uint8)
    grid = np.arange(side, dtype=np.float32)
    for _ in range(60):
        centre, radius = rng.uniform(0.1, 0.9, 3) * side, rng.uniform(0.03, 0.06) * side
        low, high = np.maximum(centre - radius - 2, 0).astype(int), np.minimum(centre + radius + 3, side).astype(int)
        z, y, x = (grid[a:b] - c for a, b, c in zip(low, high, centre, strict=True))
        distance = np.sqrt(z[:, None, None] ** 2 + y[:, None] ** 2 + x**2)
        shell = 230 * np.exp(-((distance - radius) ** 2) / 2)
        part = volume[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
        np.maximum(part, shell.astype(np.uint8), out=part)
    return volume


def dense(side: int) -> np.ndarray:
    """Band-limited noise: nothing of it is empty."""
    from scipy import ndimage

    noise = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal((side, side, side)).astype(np.float32), 2)
    return np.clip(128 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)


class Ours:
    def __init__(self, values: np.ndarray, mode: str) -> None:
        self.renderer = Renderer()
        self.renderer.canvas.moving = mode.endswith("moving")
        mode = mode.removesuffix(" moving")
        self.volume = Volume((Band(values, (FLOOR, FULL)),))
        self.mode = mode
        self.look = VolumeLook(threshold=100, transfer=Transfer(((FLOOR, 0), (FULL, OPACITY)), 1.0))

    def draw(self, angle: float) -> np.ndarray:
        view = View(angle, 20, pixel_um=400 / 512 * SIDE / 256)
        return self.renderer.draw(Scene((Layer(self.volume, self.mode, self.look),), view), SIZE)


class Vtk:
    def __init__(self, values: np.ndarray, mode: str) -> None:
        import vtk
        from vtk.util.numpy_support import numpy_to_vtk

        self.vtk = vtk
        image = vtk.vtkImageData()
        image.SetDimensions(*values.shape[::-1])
        image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
        mapper = vtk.vtkFixedPointVolumeRayCastMapper() if mode.endswith("fixed") else vtk.vtkGPUVolumeRayCastMapper()
        mapper.SetInputData(image)
        mapper.SetAutoAdjustSampleDistances(0)
        mapper.SetSampleDistance(1.0)
        if mode.startswith("mip"):
            mapper.SetBlendModeToMaximumIntensity()
        elif mode.startswith("first"):
            mapper.SetBlendModeToIsoSurface()
        look = vtk.vtkVolumeProperty()
        colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        colour.AddRGBPoint(FLOOR, 0, 0, 0)
        colour.AddRGBPoint(FULL, 1, 1, 1)
        opacity.AddPoint(FLOOR, 0)
        opacity.AddPoint(FULL, 1 if mode.startswith("mip") else OPACITY)
        look.SetColor(colour)
        look.SetScalarOpacity(opacity)
        look.SetInterpolationTypeToLinear()
        look.GetIsoSurfaceValues().SetValue(0, 100)
        if mode.startswith("first"):
            look.ShadeOn()
        actor = vtk.vtkVolume()
        actor.SetMapper(mapper)
        actor.SetProperty(look)
        self.scene = vtk.vtkRenderer()
        self.scene.AddVolume(actor)
        self.window = vtk.vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetSize(*SIZE)
        self.window.AddRenderer(self.scene)
        camera = self.scene.GetActiveCamera()
        camera.ParallelProjectionOn()
        self.scene.ResetCamera()
        camera.SetParallelScale(200 * SIDE / 256)
        self.camera = camera

    def draw(self, angle: float) -> np.ndarray:
        from vtk.util.numpy_support import vtk_to_numpy

        self.camera.Azimuth(3)
        self.window.Render()
        grab = self.vtk.vtkUnsignedCharArray()
        self.window.GetPixelData(0, 0, SIZE[0] - 1, SIZE[1] - 1, 1, grab, 0)
        return vtk_to_numpy(grab).reshape(*SIZE, 3)


class Vispy:
    def __init__(self, values: np.ndarray, mode: str) -> None:
        import vispy

        vispy.use("glfw")
        from vispy import scene

        self.canvas = scene.SceneCanvas(size=SIZE, show=False)
        box = self.canvas.central_widget.add_view()
        method = {"mip": "mip", "translucent": "translucent", "first": "iso"}[mode]
        look = {"threshold": 100} if mode == "first" else {}
        scene.visuals.Volume(values, parent=box.scene, method=method, texture_format="auto", clim=(FLOOR, FULL), **look)
        box.camera = scene.cameras.TurntableCamera(fov=0, parent=box.scene, scale_factor=400 * SIDE / 256)
        box.camera.set_range()
        self.camera = box.camera

    def draw(self, angle: float) -> np.ndarray:
        self.canvas.set_current()
        self.camera.azimuth = angle
        return self.canvas.render()


def measured(contestants: dict[str, object]) -> dict[str, float]:
    """CPU seconds of the process for a frame: the least of several, everybody drawing in turn."""
    best = dict.fromkeys(contestants, np.inf)
    for name, each in contestants.items():
        if np.ptp(each.draw(10.0)) == 0:  # compiles and uploads
            print(f"  {name} drew nothing", flush=True)
    for k in range(FRAMES):
        for name, each in contestants.items():
            begin = time.process_time()
            each.draw(10.0 + 3 * k)
            best[name] = min(best[name], time.process_time() - begin)
    return best


def tried(make, *arguments):
    try:
        return make(*arguments)
    except Exception as error:  # noqa: BLE001  a peer that is not there is left out, and said so
        print(f"  {make.__name__}: {type(error).__name__}: {error}", flush=True)
        return None


def volumes() -> None:
    """Where the contexts do not bear each other in one process, name one contestant at a time."""
    for kind, values in (("cells", cells(SIDE)), ("dense", dense(SIDE))):
        for mode in ("mip", "translucent", "first"):
            makers = {
                "ours": (Ours, mode),
                "ours moving": (Ours, mode + " moving"),
                "vtk": (Vtk, mode),
                "vispy": (Vispy, mode),
                "vtk fixed": (Vtk, mode + " fixed"),
            }
            chosen = [
                name
                for name in makers
                if name.split()[0] in PEERS and (name not in {"vtk fixed", "ours moving"} or mode != "first")
            ]
            entries = {name: tried(makers[name][0], values, makers[name][1]) for name in chosen}
            report(f"{mode} {kind}", {name: each for name, each in entries.items() if each is not None})


def report(title: str, contestants: dict[str, object]) -> None:
    times = measured(contestants)
    peers = [seconds for name, seconds in times.items() if not name.startswith("ours")]
    own = [(name, seconds) for name, seconds in times.items() if name.startswith("ours")]
    ratio = ", ".join(f"best peer / {name} = {min(peers) / seconds:.2f}" for name, seconds in own if peers)
    print(f"{title}: " + ", ".join(f"{n} {1e3 * s:.0f}" for n, s in times.items()) + f" cpu-ms  {ratio}", flush=True)


class Function:
    def __init__(self, draw) -> None:
        self.draw = draw


def oblique() -> None:
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, vtk_to_numpy

    from display.cpu.bricks import make_bricks
    from display.cpu.planes import cut_planes
    from display.modes.slices import in_voxels, oblique_plane
    from display.rays import bounds, rays
    from display.resolve import resolve

    values = cells(SIDE)
    volume, bricks = Volume((Band(values, (0, FULL)),)), make_bricks(values)
    image = vtk.vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    reslice = vtk.vtkImageReslice()
    reslice.SetInputData(image)
    reslice.SetOutputDimensionality(2)
    reslice.SetInterpolationModeToLinear()
    reslice.SetOutputExtent(0, 511, 0, 511, 0, 0)
    reslice.SetOutputSpacing(0.78, 0.78, 1)

    def ours(angle):
        look = SliceLook(turn_deg=angle, tilt_deg=20)
        drawing = resolve(Scene((Layer(volume, "oblique", look),), View(angle, 20, pixel_um=0.78)), SIZE)[0]
        planes = in_voxels(np.array([oblique_plane(drawing)]), volume)
        box = bounds(volume, ((0, 1),) * 3)
        rays_ = rays(drawing.camera, volume)
        return cut_planes(bricks, rays_, box, SIZE, planes, limits=(0, FULL), transparent=-1e9, smooth=True)

    def theirs(angle):
        turn = vtk.vtkTransform()
        turn.RotateY(angle)
        turn.RotateX(20)
        reslice.SetResliceAxes(turn.GetMatrix())
        reslice.SetResliceAxesOrigin(SIDE / 2, SIDE / 2, SIDE / 2)
        reslice.Modified()
        reslice.Update()
        return vtk_to_numpy(reslice.GetOutput().GetPointData().GetScalars())

    report("oblique slice, trilinear", {"ours": Function(ours), "vtkImageReslice": Function(theirs)})


def shifted_pair() -> None:
    values = cells(SIDE)
    volume, renderer = Volume((Band(values, (FLOOR, FULL)),)), Renderer()
    base = Scene((Layer(volume, "shift", VolumeLook(interpolation="nearest")),), View(pixel_um=1.0), Stereo("parallel"))
    size = (SIDE, SIDE)

    def pair(scene):
        return lambda _: np.hstack([renderer.draw(scene, size, eye) for eye in ("left", "right")])

    cast = replace(base, layers=(Layer(volume, "mip", VolumeLook()),))
    report("stereo pair", {"ours": Function(pair(base)), "the pair cast": Function(pair(cast))})


if __name__ == "__main__":
    for part in (volumes, oblique, shifted_pair):
        tried(part)
