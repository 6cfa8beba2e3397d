"""What every test shares: one torch thread, a fixed seed, and the real motion data where it is present."""

from __future__ import annotations

import os
from pathlib import Path

import matplotlib
import pytest
import torch

REPOSITORY = Path(__file__).parents[1]

matplotlib.use("Agg")
torch.set_num_threads(1)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Leave out what needs a GPU where there is none."""
    if not torch.cuda.is_available():
        for item in items:
            if item.get_closest_marker("gpu"):
                item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU"))


@pytest.fixture(autouse=True)
def seed() -> int:
    """Seed the global generator, which only the initial weights of networks draw from."""
    torch.manual_seed(0)
    return 0


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded generator of the test's own."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="session")
def repository() -> Path:
    """Root of the checkout."""
    return REPOSITORY


@pytest.fixture(scope="session")
def data() -> Path:
    """Folder of real dog motion, from ``AGILITY_RL_DATA`` or beside the checkout; without it the test is skipped."""
    named = os.environ.get("AGILITY_RL_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip(f"needs real motion data: no folder {folder}; name one by the environment variable AGILITY_RL_DATA")
    return folder
