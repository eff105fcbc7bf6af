"""Richardson-Lucy by RedLionfish on the processor: VOLUME.npz STEPS OUT.npy; prints its CPU seconds."""

import sys
import time

import numpy as np
import RedLionfishDeconv

data = np.load(sys.argv[1])
begin = time.process_time()
found = RedLionfishDeconv.doRLDeconvolutionFromNpArrays(
    data["seen"], data["psf"], niter=int(sys.argv[2]), method="cpu", resAsUint8=False
)
print("cpu_s", time.process_time() - begin)
np.save(sys.argv[3], found)
