"""Batches, drawn by worker processes where that pays."""

import os
from collections.abc import Generator, Mapping
from typing import Protocol

import joblib
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from zerobev.common.errors import InputError
from zerobev.data.samples import as_float

#: More read no faster from one disk.
_MAX_WORKERS = 16

Batch = Mapping[str, Tensor]


class Source(Protocol):
    """Training data without an end, addressed by step."""

    def batch(self, step: int, rank: int = 0, ranks: int = 1) -> Batch:
        """The share of process `rank` of `ranks` in the batch of `step`.

        The batch holds the samples `step * n ... (step + 1) * n - 1`, n = `TrainConfig.batch`; a process gets every
        `ranks`-th of them, from `rank` on. Depends on nothing else, may be called in another process, and does not
        touch torch's global generator.
        """


class _Steps(Dataset):
    """A process's share of a source, as torch's loader reads it: item number i is the batch of step i."""

    def __init__(self, source: Source, place: tuple[int, int]) -> None:
        self._source, self._place = source, place

    def __getitem__(self, step: int) -> Batch | InputError:
        try:
            return self._source.batch(step, *self._place)
        except InputError as error:  # raised where it is received: the loader would wrap it into a worker's traceback
            return error


def batches(
    source: Source,
    steps: range,
    device: torch.device,
    place: tuple[int, int] = (0, 1),
    workers: int | None = None,
) -> Generator[Batch, None, None]:
    """The batches of `steps`, in order, on the device: of a training, or of a pass over test views.

    place: rank of this process, and the number of those that share each batch
    workers: processes that draw batches ahead of their use; they change nothing but the time. Default: `gpu_workers`
        on a GPU, none on a CPU, where they would take from a step what they save.

    Raises `InputError` as the source does, and `RuntimeError` where a worker dies.
    """
    on_gpu = device.type == "cuda"
    if workers is None:
        workers = gpu_workers() if on_gpu else 0
    loader = DataLoader(
        _Steps(source, place),
        batch_size=None,  # a source's batches are whole
        sampler=steps,
        num_workers=workers,
        pin_memory=on_gpu,
        generator=torch.Generator(),  # of seeds that no source takes; the global one is that of dropout
    )
    for batch in loader:
        if isinstance(batch, InputError):
            raise batch
        yield moved(batch, device)


def model_inputs(batch: Batch) -> list[Tensor]:
    """Arguments of a model's call: `rgb`, `zero`, and `depth` if the batch has it."""
    return [batch[name] for name in ("rgb", "zero", "depth") if name in batch]


def moved(batch: Batch, device: torch.device) -> Batch:
    """The batch on the device, and only there as floats."""
    return as_float({name: value.to(device, non_blocking=True) for name, value in batch.items()})


def gpu_workers() -> int:
    """Workers beside a training on a GPU: the cores that each of this machine's trainings has beside its own."""
    trainings = int(os.environ.get("LOCAL_WORLD_SIZE", 1))  # as `accelerate launch` says
    return min(max(joblib.cpu_count() // trainings - 1, 1), _MAX_WORKERS)
