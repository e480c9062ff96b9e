"""Batches on the device, optionally drawn by worker processes."""

import os
from collections.abc import Generator, Mapping
from typing import Protocol

import joblib
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from zerobev.common.errors import InputError
from zerobev.data.samples import as_float

#: More workers read no faster from one disk.
_MAX_WORKERS = 16

Batch = Mapping[str, Tensor]


class Source(Protocol):
    """Endless training data, addressed by step."""

    def batch(self, step: int, rank: int = 0, world_size: int = 1) -> Batch:
        """Part of process `rank` in the batch of `step`.

        The batch holds the samples `step * n ... (step + 1) * n - 1`, n = `TrainConfig.batch`; its part is every
        `world_size`-th of them, from `rank` on. The result depends only on the arguments. Calls may come from another
        process and leave torch's global generator unchanged.
        """


class _Steps(Dataset):
    """A source as a torch dataset: item i is this process's part of the batch of step i."""

    def __init__(self, source: Source, rank: int, world_size: int) -> None:
        self._source, self._rank, self._world_size = source, rank, world_size

    def __getitem__(self, step: int) -> Batch | InputError:
        try:
            return self._source.batch(step, self._rank, self._world_size)
        except InputError as error:  # raised by `batches`: torch's loader would add the worker's traceback
            return error


def batches(
    source: Source,
    steps: range,
    device: torch.device,
    rank: int = 0,
    world_size: int = 1,
    workers: int | None = None,
) -> Generator[Batch, None, None]:
    """The batches of `steps`, in order, on the device: of a training, or of a pass over test views.

    rank, world_size: of the processes among which each batch is divided
    workers: processes that draw batches ahead of their use, with the same result. Default: `gpu_workers` on a GPU; none
        on a CPU, where they would slow down the steps

    Raises `InputError` as the source does, and `RuntimeError` if a worker dies.
    """
    on_gpu = device.type == "cuda"
    if workers is None:
        workers = gpu_workers() if on_gpu else 0
    loader = DataLoader(
        _Steps(source, rank, world_size),
        batch_size=None,  # items are whole batches
        sampler=steps,
        num_workers=workers,
        pin_memory=on_gpu,
        generator=torch.Generator(),  # unused by sources; the default would advance the global one, of dropout
    )
    for batch in loader:
        if isinstance(batch, InputError):
            raise batch
        yield moved(batch, device)


def model_inputs(batch: Batch) -> list[Tensor]:
    """Arguments of a model's call: `rgb`, `zero`, and `depth` and `height` if the batch has them."""
    return [batch[name] for name in ("rgb", "zero", "depth", "height") if name in batch]


def moved(batch: Batch, device: torch.device) -> Batch:
    """The batch on the device, converted to floats there."""
    return as_float({name: value.to(device, non_blocking=True) for name, value in batch.items()})


def gpu_workers() -> int:
    """Number of workers for training on a GPU: the cores per training process of this machine, less one."""
    processes = int(os.environ.get("LOCAL_WORLD_SIZE", 1))  # set by `accelerate launch`
    return min(max(joblib.cpu_count() // processes - 1, 1), _MAX_WORKERS)
