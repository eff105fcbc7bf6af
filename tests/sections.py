"""A block-face bench for tests: instrument file, recipe, and a session in this process over the bench's wires."""

from contextlib import contextmanager

from acquire.recipe import load_recipe
from acquire.session import Options, new_session, resumed_session
from acquire.store import open_run
from devices.clock import SystemClock
from devices.rig import load_rig, open_rig

BENCH = """
schema = 1
name = "block-face"
[camera]
driver = "sim"
size_px = [48, 40]
bit_depth = 12
pixel_um = 3.45
exposure_ms = 1.0
[optics]
magnification = 20.0
na = 0.45
[stage.z]
driver = "asi-ms2000"
port = "filled in by the bench"
baud = 115200
limits = { min_um = -100.0, max_um = 100.0 }
park_um = -90.0
speed_um_s = 5000.0
[microtome]
driver = "modbus"
profile = "plc-mailbox"
port = "filled in by the bench"
limits = { feed_um_max = 4000.0, thickness_nm_min = 20, thickness_nm_max = 2000 }
[microtome.knife]
window_um = [3.0, 0.0]
speed_um_s = 300.0
clearance_um = 5.0
"""

RECIPE = """
schema = 1
name = "t"
[output]
keep_free_gb = 0.001
[stack]
top_um = 2.0
bottom_um = -2.0
step = 4.0
[sections]
count = 3
thickness_nm = 500
"""


def files(folder, bench=BENCH, recipe=RECIPE):
    """Write instrument file and recipe and return their paths."""
    paths = folder / "bench.toml", folder / "recipe.toml"
    for path, text in zip(paths, (bench, recipe), strict=True):
        path.write_text(text)
    return paths


@contextmanager
def ready_rig(bench):
    """The bench's instrument, its feed homed."""
    with open_rig(load_rig(bench.instrument), clock=SystemClock()) as rig:
        if rig.feed is not None and str(rig.feed.resolve()) != "ready":
            rig.feed.home()
        yield rig


def run_sections(bench, recipe, folder, *, tell=lambda _: None, change=(), **options):
    """Take a run to its end and return its session and outcome."""
    with ready_rig(bench) as rig:
        session = new_session(load_recipe(recipe, change), rig, folder, SystemClock(), tell, Options(**options))
        return session, session.execute()


def go_on(bench, folder, *, tell=lambda _: None, **options):
    """Take the rest of a run and return its session and outcome."""
    with open_rig(load_rig(bench.instrument), clock=SystemClock()) as rig:
        session = resumed_session(open_run(folder), rig, SystemClock(), tell, Options(**options))
        return session, session.execute()


def cuts(bench):
    """Strokes that the knife of the bench really made."""
    return bench.ask(do="truth")["counters"]["feed"]["cuts"]
