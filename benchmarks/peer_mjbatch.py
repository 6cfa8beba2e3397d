"""The engine of mjbatch on a model and targets of ``env_step.py``, which runs this in the peer's environment."""

from __future__ import annotations

import sys
from pathlib import Path

import mjbatch
import mujoco
import numpy as np
from peer import serve


def main() -> None:
    """Step all robots through all targets for every order."""
    folder, threads, substeps = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    targets, start = np.load(folder / "targets.npy"), np.load(folder / "start.npy")
    batch = mjbatch.Batch(mujoco.MjModel.from_xml_path(str(folder / "model.xml")), targets.shape[1], threads)
    batch.bind("qpos")[:] = start
    batch.forward()
    control = batch.bind("ctrl")

    def turn() -> None:
        for target in targets:
            control[:] = target
            batch.step(nstep=substeps)

    serve(lambda: turn)


if __name__ == "__main__":
    main()
