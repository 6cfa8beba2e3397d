"""Where Warp computes: which devices it can use, and launches on torch's device and stream."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import torch

from agility_rl.simulation.simulator import HardwareError

try:
    import warp as wp

    wp.config.log_level = max(wp.config.log_level, wp.LOG_ERROR)  # not a line for each kernel that is compiled
    import mujoco_warp as mjw
except ImportError as error:
    raise ImportError("the simulator 'warp' needs mujoco-warp: pip install 'agility_rl[gpu]'") from error

__all__ = ["mjw", "on_device", "usable_device", "wp"]


@contextlib.contextmanager
def on_device(device: torch.device) -> Iterator[None]:
    """Launch Warp's kernels on torch's device, in torch's present stream.

    Source: Warp's documentation, "PyTorch, stream conversion".

    Example:
        >>> with on_device(torch.device("cpu")):
        ...     wp.get_device().is_cpu
        True
    """
    with wp.ScopedDevice(wp.device_from_torch(device)):
        if device.type != "cuda":
            yield
            return
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device))):
            yield


def usable_device(device: torch.device | str) -> torch.device:
    """The device, if torch and Warp can use it.

    Raises:
        HardwareError: saying what is missing.

    Example:
        >>> usable_device("cpu")
        device(type='cpu')
    """
    wanted = f"the simulator 'warp' runs on cuda, or on cpu for tests, got device {str(device)!r}"
    try:
        device = torch.device(device)
    except RuntimeError:
        raise HardwareError(wanted) from None
    if device.type == "cpu":
        return device
    if device.type != "cuda":
        raise HardwareError(wanted)
    if torch.version.cuda is None:
        lacks = f"this PyTorch ({torch.__version__}) is built without CUDA; install one with it"
    elif not torch.cuda.is_available() or not wp.is_cuda_available():
        lacks = "no NVIDIA driver answers (12.4 or newer is needed); look at nvidia-smi"
    elif (device.index or 0) >= torch.cuda.device_count():
        lacks = f"there are only {torch.cuda.device_count()} GPUs, counted from 0; give another number"
    else:
        return torch.device("cuda", torch.cuda.current_device() if device.index is None else device.index)
    raise HardwareError(f"the simulator 'warp' cannot run on {device}: {lacks}, or take the simulator 'batch'")
