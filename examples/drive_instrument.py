"""Drive an instrument from a script: ``stereotome serve --sim`` in one terminal, this in another.

Looks for the sharpest place by hand, then takes a fine stack around it as a run, and shows how it goes.
"""

from __future__ import annotations

import numpy as np

from acquire.client import Instrument
from acquire.replies import Event, Told

RECIPE = """
schema = 1
name = "around-best-focus"
[stack]
top_um = {top:.2f}
bottom_um = {bottom:.2f}
step = 0.5
"""


def sharpness(pixels: np.ndarray) -> float:
    """Return the variance of neighbouring differences, relative to the mean: high where the picture is sharp."""
    grey = pixels.astype(float)
    return float(np.var(np.diff(grey, axis=1)) / np.mean(grey) ** 2)


def told(what: Told) -> None:
    """Print each plane of a run."""
    if isinstance(what, Event) and what.event["event"] == "plane":
        print(f"  plane {what.event['plane']} at {what.event['z_um']:+.2f} µm")


def main() -> None:
    """Look, then take."""
    with Instrument.connect() as instrument:
        instrument.command("example")
        instrument.set_camera(exposure_ms=10.0)
        seen = {}
        for z_um in np.arange(-15.0, 15.1, 3.0):
            at_um = instrument.move(float(z_um))
            pixels, _ = instrument.snap()
            seen[at_um] = sharpness(pixels)
            print(f"{at_um:+7.2f} µm  sharpness {seen[at_um]:.4f}")
        best_um = max(seen, key=seen.__getitem__)
        print(f"sharpest at {best_um:+.2f} µm; a stack around it:")
        instrument.listen(told)
        instrument.start_run(RECIPE.format(top=best_um + 3, bottom=best_um - 3))
        run = instrument.wait_for_run()
        print(f"{run.state}: {run.durable} of {run.planned} planes in {run.folder}")


if __name__ == "__main__":
    main()
