"""Cost of the signature of a body, by the igps on the path: the current version, or that of commit fa3a05e.

    python signing.py BODY.npz

The archive holds the vertices and faces. Each line of standard input is a configuration as JSON. The script prints the
seconds of processor time for each.
"""

import json
import sys
import time

import numpy as np
import torch

import igps


def main():
    torch.set_num_threads(1)
    with np.load(sys.argv[1]) as arrays:
        mesh = igps.Mesh(arrays["vertices"], arrays["faces"])
    known = set()
    for line in sys.stdin:
        parameters = json.loads(line)
        config = igps.SignatureConfig(
            **{**parameters, "attributes": tuple(parameters["attributes"])}
        )
        if line not in known:
            known.add(line)
            igps.compute_signature(mesh, config)  # the first call loads and compiles functions
        start = time.process_time()
        igps.compute_signature(mesh, config)
        print(time.process_time() - start, flush=True)


if __name__ == "__main__":
    main()
