"""Stack a folder with Stereotome, like for like: read RGB TIFF, measure, gather RGB, write; FOLDER OUT METHOD."""

import sys
import time
from pathlib import Path

import numpy as np
import tifffile

from processing.focus import focus_stack

folder, out, method = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
focus_stack(list(np.zeros((3, 32, 32, 3), np.uint8)), method=method, register=False)  # kernels loaded
begin = time.process_time()
planes = [tifffile.imread(path) for path in sorted(folder.glob("*.tif"))]
result = focus_stack(planes, method=method, register=False)
out.mkdir(exist_ok=True)
tifffile.imwrite(out / "focus.tif", result.extended_focus, photometric="rgb")
np.save(out / "range.npy", result.range)
print("cpu_s", time.process_time() - begin)
