"""Stack a folder of images with shinestacker: FOLDER OUT METHOD; runs in the peer's own environment."""

import sys
import time
from pathlib import Path

from shinestacker.algorithms import DepthMapStack, FocusStack, PyramidStack, StackJob

folder, out, method = Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]
algorithm = PyramidStack() if method == "pyramid" else DepthMapStack()
job = StackJob("bench", str(folder.parent), input_path=folder.name)
job.add_action(FocusStack("stack", algorithm, output_path=str(out), prefix="s_", plot_stack=False))
begin = time.process_time()
job.run()
print("\ncpu_s", time.process_time() - begin)
