"""What draws beside us: each contestant draws one scene on request, from the same side, at the same size.

Peers are not locked. Install vtk, vispy, PyOpenGL and pygfx into an environment of their own and name its site-packages
in ``STEREOTOME_PEERS``. pygfx needs a Vulkan driver, vispy an X server (xvfb).
"""

from __future__ import annotations

import os
import sys

import numpy as np

sys.path.append(os.environ.get("STEREOTOME_PEERS", ""))  # behind our own packages

from display.scene import Band, Layer, Scene, SliceLook, Transfer, View, Volume, VolumeLook
from display.stereo import Stereo

SIZE = (512, 512)
FLOOR, FULL, LEVEL = 12, 255, 100
OPACITY = 0.05
FRAMES, FRAME = 8, 2048  # of a camera


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


def frames(_: int) -> np.ndarray:
    """Pictures of a camera, uint16."""
    rng = np.random.default_rng(2)
    base = rng.integers(0, 60000, (FRAME, FRAME), np.uint16)
    return np.stack([np.roll(base, 37 * k, axis=1) for k in range(FRAMES)])


SPECIMENS = {"cells": cells, "dense": dense, "frames": frames}


def seen_from(angle: float, side: int) -> View:
    """Return the view at an angle: 400 of 256 voxels across the picture."""
    return View(angle, 20, pixel_um=400 / 512 * side / 256)


def directions(angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the unit vectors right, up and away from the viewer."""
    from display.resolve import axes

    right, down, into = axes(View(angle, 20))
    return right, -down, into


class Ours:
    """Our renderer; ``moving`` as while a picture is turned."""

    def __init__(self, values: np.ndarray, mode: str, *, moving: bool = False) -> None:
        from display.gl.renderer import Renderer

        self.renderer, self.side, self.mode = Renderer(), len(values), mode
        self.renderer.canvas.moving = moving
        self.volume = Volume((Band(values, (FLOOR, FULL)),))
        self.look = VolumeLook(threshold=LEVEL, transfer=Transfer(((FLOOR, 0), (FULL, OPACITY)), 1.0))

    def draw(self, angle: float) -> np.ndarray:
        scene = Scene((Layer(self.volume, self.mode, self.look),), seen_from(angle, self.side))
        return self.renderer.draw(scene, SIZE)


class OursMoving(Ours):
    """Our renderer while a picture is turned."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        super().__init__(values, mode, moving=True)


class OursLive:
    """The console's live picture."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        from display.gl.canvas import Canvas
        from display.gl.context import offscreen
        from display.gl.live_picture import LivePicture

        self.picture, self.values, self.number = LivePicture(Canvas(offscreen())), values, 0
        self.table = np.repeat(np.linspace(0, 1, 256, dtype=np.float32)[None, :, None], 3, axis=2)

    def draw(self, angle: float) -> np.ndarray:
        del angle
        self.number += 1
        pixels = self.values[self.number % FRAMES]
        place, levels = (0.0, 0.0, 1024 / FRAME), (0.0, 60000.0, 1.0, 65535.0, False)
        self.picture.draw(pixels, self.number, size=(1024, 1024), place=place, table=self.table, levels=levels)
        return self.picture.read()


class OursOblique:
    """Our cut through a volume."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        from display.cpu.bricks import make_bricks

        del mode
        self.volume, self.bricks, self.side = Volume((Band(values, (0, FULL)),)), make_bricks(values), len(values)

    def draw(self, angle: float) -> np.ndarray:
        from display.cpu.planes import cut_planes
        from display.modes.slices import in_voxels, oblique_plane
        from display.rays import bounds, rays
        from display.resolve import resolve

        layer = Layer(self.volume, "oblique", SliceLook(turn_deg=angle, tilt_deg=20))
        drawing = resolve(Scene((layer,), View(angle, 20, pixel_um=0.78 * self.side / 256)), SIZE)[0]
        planes = in_voxels(np.array([oblique_plane(drawing)]), self.volume)
        box, seen_by = bounds(self.volume, ((0, 1),) * 3), rays(drawing.camera, self.volume)
        return cut_planes(self.bricks, seen_by, box, SIZE, planes, limits=(0, FULL), transparent=-1e9, smooth=True)[
            ..., 0
        ]


class OursPair:
    """A stereo pair, of shifted planes or cast."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        from display.gl.renderer import Renderer

        self.renderer, self.size = Renderer(), (len(values), len(values))
        look = VolumeLook(interpolation="nearest" if mode == "shift" else "trilinear")
        self.scene = Scene(
            (Layer(Volume((Band(values, (FLOOR, FULL)),)), mode, look),), View(pixel_um=1.0), Stereo("parallel")
        )

    def draw(self, angle: float) -> np.ndarray:
        del angle
        return np.hstack([self.renderer.draw(self.scene, self.size, eye) for eye in ("left", "right")])


class VtkGpu:
    """VTK, by OpenGL."""

    mapper = "vtkGPUVolumeRayCastMapper"

    def __init__(self, values: np.ndarray, mode: str) -> None:
        import vtk

        self.vtk, self.side = vtk, len(values)
        mapper = getattr(vtk, self.mapper)()
        mapper.SetInputData(vtk_image(values))
        mapper.SetAutoAdjustSampleDistances(0)
        mapper.SetSampleDistance(1.0)
        if mode == "mip":
            mapper.SetBlendModeToMaximumIntensity()
        elif mode == "first":
            mapper.SetBlendModeToIsoSurface()
        look = vtk.vtkVolumeProperty()
        colour, opacity = vtk.vtkColorTransferFunction(), vtk.vtkPiecewiseFunction()
        colour.AddRGBPoint(FLOOR, 0, 0, 0)
        colour.AddRGBPoint(FULL, 1, 1, 1)
        opacity.AddPoint(FLOOR, 0)
        opacity.AddPoint(FULL, 1 if mode == "mip" else OPACITY)
        look.SetColor(colour)
        look.SetScalarOpacity(opacity)
        look.SetInterpolationTypeToLinear()
        look.GetIsoSurfaceValues().SetValue(0, LEVEL)
        if mode == "first":
            look.ShadeOn()
        actor = vtk.vtkVolume()
        actor.SetMapper(mapper)
        actor.SetProperty(look)
        scene = vtk.vtkRenderer()
        scene.AddVolume(actor)
        self.scene, self.window = scene, vtk.vtkRenderWindow()
        self.window.SetOffScreenRendering(1)
        self.window.SetSize(*SIZE)
        self.window.AddRenderer(scene)
        scene.GetActiveCamera().ParallelProjectionOn()

    def draw(self, angle: float) -> np.ndarray:
        from vtk.util.numpy_support import vtk_to_numpy

        _, up, into = directions(angle)
        camera, middle = self.scene.GetActiveCamera(), np.full(3, (self.side - 1) / 2)
        camera.SetFocalPoint(*middle)
        camera.SetPosition(*(middle - 4 * self.side * into))
        camera.SetViewUp(*up)
        camera.SetParallelScale(200 * self.side / 256)
        self.scene.ResetCameraClippingRange()
        self.window.Render()
        grab = self.vtk.vtkUnsignedCharArray()
        self.window.GetPixelData(0, 0, SIZE[0] - 1, SIZE[1] - 1, 1, grab, 0)
        return vtk_to_numpy(grab).reshape(*SIZE, 3)[::-1]


class VtkFixed(VtkGpu):
    """VTK, by the processor."""

    mapper = "vtkFixedPointVolumeRayCastMapper"


class VtkReslice:
    """VTK's cut through a volume."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        import vtk

        del mode
        self.vtk, self.side, self.reslice = vtk, len(values), vtk.vtkImageReslice()
        self.reslice.SetInputData(vtk_image(values))
        self.reslice.SetOutputDimensionality(2)
        self.reslice.SetInterpolationModeToLinear()
        self.reslice.SetOutputSpacing(*(0.78 * self.side / 256,) * 2, 1)
        self.reslice.SetOutputExtent(0, SIZE[0] - 1, 0, SIZE[1] - 1, 0, 0)
        self.reslice.SetOutputOrigin(*(-0.78 * self.side / 256 * (n - 1) / 2 for n in SIZE), 0)

    def draw(self, angle: float) -> np.ndarray:
        from vtk.util.numpy_support import vtk_to_numpy

        right, up, into = directions(angle)
        self.reslice.SetResliceAxesDirectionCosines(*right, *-up, *into)
        self.reslice.SetResliceAxesOrigin(*np.full(3, (self.side - 1) / 2))
        self.reslice.Modified()
        self.reslice.Update()
        return vtk_to_numpy(self.reslice.GetOutput().GetPointData().GetScalars()).reshape(SIZE[::-1])


def vtk_image(values: np.ndarray):
    """Return a volume as VTK has it."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk

    image = vtk.vtkImageData()
    image.SetDimensions(*values.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(values.ravel(), deep=True))
    return image


class Vispy:
    """vispy, whose 3-D pictures napari shows."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        import vispy

        vispy.use("glfw")
        from vispy import color, scene

        self.side, self.scene = len(values), scene
        self.canvas = scene.SceneCanvas(size=SIZE, show=False)
        box = self.canvas.central_widget.add_view()
        look = {
            "mip": {"method": "mip"},
            "first": {"method": "iso", "threshold": (LEVEL - FLOOR) / (FULL - FLOOR)},
        }.get(mode, {})
        if mode == "translucent":
            look = {"method": "translucent", "cmap": color.Colormap([(0, 0, 0, 0), (1, 1, 1, OPACITY)])}
        self.volume = scene.visuals.Volume(values, parent=box.scene, texture_format="auto", clim=(FLOOR, FULL), **look)
        self.volume.transform = scene.transforms.MatrixTransform()
        box.camera = scene.cameras.TurntableCamera(
            fov=0, elevation=90, azimuth=0, scale_factor=400 * self.side / 256, center=(0, 0, 0)
        )

    def draw(self, angle: float) -> np.ndarray:
        right, up, into = directions(angle)
        turn = np.eye(4)
        turn[:3, :3] = np.column_stack([right, up, -into])
        move = np.eye(4)
        move[3, :3] = -(self.side - 1) / 2
        self.canvas.set_current()
        self.volume.transform.matrix = move @ turn
        return self.canvas.render()[..., :3]


class VispyLive:
    """vispy's live picture."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        import vispy

        del mode
        vispy.use("glfw")
        from vispy import scene

        self.canvas = scene.SceneCanvas(size=(1024, 1024), show=False)
        box = self.canvas.central_widget.add_view()
        self.image = scene.visuals.Image(
            values[0], parent=box.scene, texture_format="auto", clim=(0, 60000), cmap="grays", interpolation="nearest"
        )
        box.camera = scene.cameras.PanZoomCamera(aspect=1, rect=(0, 0, FRAME, FRAME))
        self.values, self.number = values, 0

    def draw(self, angle: float) -> np.ndarray:
        del angle
        self.number += 1
        self.canvas.set_current()
        self.image.set_data(self.values[self.number % FRAMES])
        return self.canvas.render()[::-1, :, :3]


class Pygfx:
    """pygfx, by Vulkan; it has no translucent volumes."""

    def __init__(self, values: np.ndarray, mode: str) -> None:
        import pygfx
        from rendercanvas.offscreen import OffscreenRenderCanvas

        self.side = len(values)
        self.canvas = OffscreenRenderCanvas(size=SIZE, pixel_ratio=1)
        renderer = pygfx.renderers.WgpuRenderer(self.canvas)
        look = {"clim": (FLOOR, FULL), "interpolation": "linear"}
        material = (
            pygfx.VolumeMipMaterial(**look)
            if mode == "mip"
            else pygfx.VolumeIsoMaterial(threshold=LEVEL / FULL, step_size=1.0, **look)
        )
        scene = pygfx.Scene()
        scene.add(pygfx.Volume(pygfx.Geometry(grid=pygfx.Texture(values, dim=3)), material))
        scene.add(pygfx.AmbientLight())
        reach = 400 * self.side / 256
        self.camera = pygfx.OrthographicCamera(reach, reach, depth_range=(1, 20 * self.side))
        scene.add(self.camera.add(pygfx.DirectionalLight()))
        self.canvas.request_draw(lambda: renderer.render(scene, self.camera))

    def draw(self, angle: float) -> np.ndarray:
        _, up, into = directions(angle)
        middle = np.full(3, (self.side - 1) / 2)
        self.camera.world.reference_up = up
        self.camera.local.position = middle - 4 * self.side * into
        self.camera.look_at(middle)
        return np.asarray(self.canvas.draw())[..., :3]
