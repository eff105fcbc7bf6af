"""What other programs make of the same pairs of sections: run by bench_align.py in an environment of their own.

Run: ``python align_peers.py SCENE.npz`` with ``images`` (n, y, x) uint8. Prints JSON: for each program the matrices of
neighbours, from pixel (x, y) of the first to pixel (x, y) of the second, and the CPU seconds they took.
"""

import json
import sys
import time
from itertools import pairwise

import numpy as np


def pystackreg_affine(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    from pystackreg import StackReg

    return StackReg(StackReg.AFFINE).register(first.astype(float), second.astype(float))


def elastix_affine(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    import itk

    parameters = itk.ParameterObject.New()
    parameters.AddParameterMap(itk.ParameterObject.GetDefaultParameterMap("affine"))
    images = [itk.image_from_array(image.astype(np.float32)) for image in (first, second)]
    _, found = itk.elastix_registration_method(*images, parameter_object=parameters, log_to_console=False)
    values = found.GetParameterMap(0)
    six = [float(v) for v in values["TransformParameters"]]
    centre = np.array([float(v) for v in values["CenterOfRotationPoint"]])
    matrix = np.eye(3)
    matrix[:2, :2] = np.array(six[:4]).reshape(2, 2)
    matrix[:2, 2] = centre + six[4:] - matrix[:2, :2] @ centre
    return matrix


PEERS = {"pystackreg affine": pystackreg_affine, "elastix affine": elastix_affine}


def main() -> None:
    images = np.load(sys.argv[1])["images"]
    chosen = sys.argv[2:] or list(PEERS)
    found = {}
    for name in chosen:
        PEERS[name](*images[:2])  # loads its library
        start = time.process_time()
        matrices = [PEERS[name](a, b).tolist() for a, b in pairwise(images)]
        found[name] = {"matrices": matrices, "seconds": time.process_time() - start}
    print(json.dumps(found))


if __name__ == "__main__":
    main()
