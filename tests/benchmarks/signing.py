"""What the signature of a body costs, by whichever igps is on the path: of now, or of commit fa3a05e.

    python signing.py BODY.npz

The archive holds the vertices and faces. For each line of its input, the configuration as JSON, it tells the seconds of
processor time.
"""

from __future__ import annotations

import json
import sys
import time

import numpy as np
import torch

import igps


def main() -> None:
    torch.set_num_threads(1)
    with np.load(sys.argv[1]) as arrays:
        mesh = igps.Mesh(arrays["vertices"], arrays["faces"])
    made = set()
    for line in sys.stdin:
        parameters = json.loads(line)
        config = igps.SignatureConfig(**{**parameters, "attributes": tuple(parameters["attributes"])})
        if line not in made:
            made.add(line)
            igps.compute_signature(mesh, config)  # with all that is loaded and compiled the first time
        start = time.process_time()
        igps.compute_signature(mesh, config)
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
