"""Packages to compare with, in processes of an environment of their own, so that ours need not have them.

python -m venv build/peer && build/peer/bin/pip install torch==2.13.0 rsl-rl-lib mjbatch
"""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

INSTALL = __doc__.strip().splitlines()[-1].strip()


class Peer:
    """A script in another Python that does one piece of work whenever it is asked.

    Args:
        python: the other Python.
        script: what it runs; it calls :func:`serve`.
        arguments: of the script.

    Raises:
        SystemExit: if there is no such Python, or the script ends before it has answered.
    """

    def __init__(self, python: Path | None, script: Path, *arguments: str) -> None:
        if python is None or not python.is_file():
            raise SystemExit(
                f"--peer: expected the Python of another environment, got {python}; make one by\n{INSTALL}"
            )
        self.process = subprocess.Popen(
            [str(python), str(script), *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def ask(self, **order: Any) -> float:
        """Have it do what ``order`` says; returns the seconds that it took."""
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(json.dumps(order) + "\n")
        self.process.stdin.flush()
        answer = self.process.stdout.readline()
        if not answer:
            raise SystemExit("--peer: the other Python ended; what it said stands above")
        return float(answer)

    def close(self) -> None:
        """End it."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        self.process.wait()


def serve(work: Callable[..., Callable[[], object]]) -> None:
    """In the other Python: for every order, do what ``work(**order)`` returns, and answer how long that took."""
    for line in sys.stdin:
        run = work(**json.loads(line))
        start = time.perf_counter()
        run()
        print(time.perf_counter() - start, flush=True)
