"""Several processes that train one policy, each with robots of its own: what they have to agree on.

``torchrun`` starts them and tells each who it is; a program that was started otherwise is alone, and everything here
then gives back what it is given.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterable, Iterator, Mapping

import torch
import torch.distributed as dist
from torch import Tensor, nn


@contextlib.contextmanager
def processes(cuda: bool | None = None) -> Iterator[None]:
    """Join the processes that ``torchrun`` started, and leave them at the end; nothing if there are none.

    Tensors on a CPU travel by gloo, those on a GPU by NCCL.

    Args:
        cuda: whether each has a GPU; by default where there is any.

    Example:
        >>> with processes():
        ...     rank(), size()
        (0, 1)
    """
    if int(os.environ.get("WORLD_SIZE", "1")) < 2 or dist.is_initialized():
        yield
        return
    if torch.cuda.is_available() if cuda is None else cuda:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
        dist.init_process_group("cpu:gloo,cuda:nccl")
    else:
        dist.init_process_group("gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def rank() -> int:
    """Which of the processes this is, joined or not; 0 writes logs and checkpoints."""
    return dist.get_rank() if dist.is_initialized() else int(os.environ.get("RANK", "0"))


def size() -> int:
    """How many processes there are."""
    return dist.get_world_size() if dist.is_initialized() else 1


def wait() -> None:
    """Until all are here."""
    if size() > 1:
        dist.barrier()


def total(value: Tensor) -> Tensor:
    """Sum over all processes.

    Args:
        value: of any shape, the same everywhere.

    Example:
        >>> total(torch.tensor([1.0, 2.0]))
        tensor([1., 2.])
    """
    if size() == 1:
        return value
    summed = value.detach().clone()
    dist.all_reduce(summed)
    return summed


def average(value: Tensor) -> Tensor:
    """Mean over all processes of floating-point numbers.

    Example:
        >>> average(torch.tensor(3.0))
        tensor(3.)
    """
    return value if size() == 1 else total(value) / size()


def moments(value: Tensor, group: Tensor, num_groups: int) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation of each group over all processes; 0 and 1 of one that has fewer than two elements.

    Args:
        value: ``[n]``.
        group: int64 ``[n]``, which one each element belongs to.
        num_groups: G, of all processes.

    Returns:
        Both ``[G]``.

    Example:
        >>> moments(torch.tensor([1.0, 3.0, 5.0]), torch.tensor([0, 0, 1]), 2)
        (tensor([2., 0.]), tensor([1.4142, 1.0000]))
    """
    member = torch.nn.functional.one_hot(group, num_groups).to(value.dtype)
    count = total(member.sum(0))
    known = count > 1.0
    mean = torch.where(known, total((member * value[:, None]).sum(0)) / count.clamp(min=1.0), 0.0)
    squares = total((member * (value[:, None] - mean).square()).sum(0))
    return mean, torch.where(known, squares / (count - 1.0).clamp(min=1.0), 1.0).sqrt()


def average_gradients(parameters: Iterable[nn.Parameter]) -> None:
    """Replace every gradient by its mean over all processes, in one exchange.

    Call it after ``backward`` and before gradients are clipped. Gradients of means over equally many samples become
    those of the mean over all of them.

    Args:
        parameters: the same in every process; those without a gradient are left out.

    Example:
        >>> weight = nn.Parameter(torch.ones(1)); (3.0 * weight).backward()
        >>> average_gradients([weight]); weight.grad
        tensor([3.])
    """
    if size() == 1:
        return
    gradients = [parameter.grad for parameter in parameters if parameter.grad is not None]
    if not gradients:
        return
    flat = average(torch.cat([gradient.flatten() for gradient in gradients]))
    for gradient, part in zip(gradients, flat.split([gradient.numel() for gradient in gradients]), strict=True):
        gradient.copy_(part.view_as(gradient))


def optimized(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    """All parameters of an optimiser, in its order."""
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def average_metrics(metrics: Mapping[str, float]) -> dict[str, float]:
    """Mean of every metric over the processes in which it is a number.

    Example:
        >>> average_metrics({"loss": 2.0})
        {'loss': 2.0}
    """
    if size() == 1:
        return dict(metrics)
    everywhere: list[dict[str, float]] = [{} for _ in range(size())]
    dist.all_gather_object(everywhere, dict(metrics))
    found: dict[str, float] = {}
    for name in dict.fromkeys(name for one in everywhere for name in one):
        values = [one[name] for one in everywhere if name in one and not math.isnan(one[name])]
        found[name] = sum(values) / len(values) if values else math.nan
    return found


def anyone(flag: bool) -> bool:
    """Whether it holds in some process.

    Example:
        >>> anyone(False)
        False
    """
    return bool(total(torch.tensor(int(flag))))


@torch.no_grad()
def share(modules: Iterable[nn.Module]) -> None:
    """Give every process the parameters and buffers of the first one.

    Example:
        >>> share([nn.Linear(2, 1)])
    """
    if size() > 1:
        for module in modules:
            for value in (*module.parameters(), *module.buffers()):
                dist.broadcast(value.data, src=0)
