"""What a measurement leaves: tables, pictures, and a page to be read."""

from __future__ import annotations

from io import BytesIO
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from processing import measure_plots as plots
from processing import pages
from processing.measure_network import BRANCHES, NODES
from processing.pictures import png_bytes
from processing.result_folder import csv_bytes

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from numpy.typing import NDArray

    from processing.grey_volume import GreyVolume
    from processing.measure_network import Network
    from processing.measuring import Measurement
    from processing.planes import Planes

    Array = NDArray[Any]

TABLES = ("features.csv", "features.parquet", "numbers.csv")
PICTURES = ("cuts.png", "sizes.png", "sizes.svg", "size_and_shape.png", "size_and_shape.svg")
GREY_PICTURES = ("grey_values.png", "grey_values.svg")
SHOWN_FEATURES = 30
PLACES = {f"{axis}_{unit}" for axis in "zyx" for unit in ("um", "voxels")} | {f"axis1_{axis}" for axis in "zyx"}
CAPTIONS = {
    "cuts.png": "Cuts through the fullest plane across z (upper left), x (right, planes from left to right) and y "
    "(below, planes from above); features outlined.",
    "grey_values.png": "Grey values of all voxels; the line is the threshold.",
    "sizes.png": "Sizes of the features.",
    "size_and_shape.png": "Shape over size of features that the border does not cut, from 27 voxels on; 1 is a ball.",
    "skeleton.png": "The skeleton seen along z: branches white, nodes red, ends yellow.",
    "ball_sizes.png": "Sizes of balls from the circles of the planes, with standard errors; the line is their mean.",
}
WORDS = {"per_um3": "1/µm³", "per_um2": "1/µm²", "per_um": "1/µm", "um3": "µm³", "um2": "µm²", "um": "µm"}
VOXEL_WORDS = {
    "per_voxels3": "1/voxel",
    "per_voxels2": "1/area of a voxel's side",
    "per_voxels": "1/side of a voxel",
    "voxels3": "voxels",
    "voxels2": "sides of voxels",
    "voxels": "voxels",
}


def split_unit(name: str) -> tuple[str, str]:
    """Return a column's name in words and its unit: ``mean_intercept_um`` is mean intercept in µm."""
    for ending, unit in (WORDS | VOXEL_WORDS).items():
        if name.endswith("_" + ending):
            return name.removesuffix("_" + ending).replace("_", " "), unit
    return name.replace("_", " "), ""


def tables(found: Measurement) -> dict[str, bytes]:
    """Encode the features as CSV and Parquet, and the numbers of the whole as CSV."""
    columns = list(found.table)
    rows = zip(*(column.tolist() for column in found.table.values()), strict=True)
    numbers = [[*split_unit(name), n.value, n.error, n.how] for name, n in found.numbers.items()]
    return {
        "features.csv": csv_bytes(columns, rows),
        "features.parquet": parquet_bytes(found.table),
        "numbers.csv": csv_bytes(["name", "unit", "value", "standard_error", "how"], numbers),
    }


def parquet_bytes(table: Mapping[str, Array]) -> bytes:
    """Encode a table as Parquet; names of columns carry the units."""
    file = BytesIO()
    pq.write_table(pa.table({name: pa.array(column) for name, column in table.items()}), file)
    return file.getvalue()


def pictures(found: Measurement, volume: GreyVolume, seen: Planes) -> dict[str, bytes]:
    """Draw cuts and plots."""
    table, unit = found.table, volume.unit
    size = table["diameter_um" if volume.spacing_um else "diameter_voxels"]
    made = {"cuts.png": plots.cuts(seen, found.labels, found.fullest, volume.spacing, unit)}
    if found.threshold is not None and found.known is not None:
        made |= plots.grey_histogram(found.known.counts, found.known.values, found.threshold)
    made |= plots.size_histogram(size, table["at_border"], unit)
    return made | plots.size_and_shape(size, table["sphericity"], table["at_border"], unit)


def page(found: Measurement, report: Mapping[str, Any], shown: Mapping[str, bytes]) -> bytes:
    """Write the page: notes first, then numbers, features, and where it all comes from."""
    parts = [pages.paragraph(_first_words(found, report)), pages.notes(report["notes"])]
    parts += [pages.picture(shown["cuts.png"], CAPTIONS["cuts.png"]), pages.heading("The whole")]
    rows = [(*split_unit(name), n.value, n.error, n.how) for name, n in found.numbers.items()]
    parts += [pages.table(["", "unit", "value", "standard error", "how"], rows)]
    parts += [pages.heading("Features"), _summary(found.table)]
    parts += [pages.picture(shown[name], CAPTIONS[name]) for name in CAPTIONS if name in shown and name != "cuts.png"]
    parts += [pages.heading("The largest"), _largest(found.table)]
    if found.network is not None:
        parts += [pages.heading("The longest branches of the skeleton"), _branches(found.network, report)]
    parts += [pages.heading("What was asked for"), pages.facts(report["question"])]
    parts += [pages.heading("Where it comes from"), pages.facts({**report["input"], **report["versions"]})]
    return pages.page(f"Measurement of {report['input']['source']}", parts)


def network_files(net: Network, *, scaled: bool) -> dict[str, bytes]:
    """Encode branches and nodes as tables, and the picture of the skeleton."""
    return {
        "branches.csv": csv_bytes(network_columns(BRANCHES, scaled=scaled), net.branches),
        "nodes.csv": csv_bytes(network_columns(NODES, scaled=scaled), net.nodes),
        "skeleton.png": png_bytes(net.picture),
    }


def network_columns(columns: Iterable[str], *, scaled: bool) -> list[str]:
    """Return the names of columns, in voxels where no size is known."""
    return list(columns) if scaled else [name.replace("_um", "_voxels") for name in columns]


def _branches(net: Network, report: Mapping[str, Any]) -> str:
    order = sorted(net.branches, key=lambda row: -row[BRANCHES.index("length_um")])[:SHOWN_FEATURES]
    columns = network_columns(BRANCHES, scaled=report["input"]["spacing_um"] is not None)
    names = [" ".join(filter(None, (words, unit and f"({unit})"))) for words, unit in map(split_unit, columns)]
    left = len(net.branches) - len(order)
    more = f"{left} more are in branches.csv." if left else "They are in branches.csv, too."
    return pages.table(names, order) + pages.paragraph(more)


def _first_words(found: Measurement, report: Mapping[str, Any]) -> str:
    given = report["input"]
    size = " × ".join(map(str, given["shape"]))
    if given["spacing_um"]:
        scale = "voxels of " + " × ".join(f"{s:.4g}" for s in given["spacing_um"]) + " µm (z, y, x)"
    else:
        scale = "voxels of unknown size: lengths are in voxels"
    level = "" if found.threshold is None else f" Threshold {found.threshold:.5g}."
    return f"{len(found.table['feature'])} features in {size} voxels (planes, rows, columns); {scale}.{level}"


def _summary(table: Mapping[str, Array]) -> str:
    """Of features that the border does not cut; of all where it cuts each."""
    whole = ~table["at_border"]
    chosen, words = (whole, "that the border does not cut") if whole.any() else (~whole, "all of which the border cuts")
    rows = []
    for name, column in table.items():
        if column.dtype.kind == "f" and name not in PLACES:
            values = column[chosen]
            values = values[np.isfinite(values)]
            if values.size:
                spread = float(values.std(ddof=1)) if values.size > 1 else None
                middle = [float(v) for v in (values.mean(), np.median(values), values.min(), values.max())]
                rows.append([*split_unit(name), middle[0], spread, *middle[1:]])
    head = ["", "unit", "mean", "standard deviation", "median", "smallest", "largest"]
    return pages.paragraph(f"{np.count_nonzero(chosen)} features {words}:") + pages.table(head, rows)


def _largest(table: Mapping[str, Array]) -> str:
    order = np.argsort(-table["voxels"], kind="stable")[:SHOWN_FEATURES]
    names = [" ".join(filter(None, (words, unit and f"({unit})"))) for words, unit in map(split_unit, table)]
    rows = [[column[k].item() for column in table.values()] for k in order]
    left = len(table["feature"]) - len(order)
    more = f"{left} more are in features.csv and features.parquet." if left else "They are in features.csv, too."
    return pages.table(names, rows) + pages.paragraph(more)
