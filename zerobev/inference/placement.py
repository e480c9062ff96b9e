"""Device and precision of a network."""

import copy
from typing import TypeVar

import torch
from torch import nn

from zerobev.common.errors import InputError, first_line

#: Types of weights and features; depth, logits and results are float32 in any case.
PRECISIONS = (torch.float32, torch.bfloat16, torch.float16)
M = TypeVar("M")


def placement(module: object) -> tuple[torch.device, torch.dtype]:
    """Device and type of a module's parameters; CPU and float32 for anything without parameters."""
    parameter = next(module.parameters(), None) if isinstance(module, nn.Module) else None
    return (torch.device("cpu"), torch.float32) if parameter is None else (parameter.device, parameter.dtype)


def placed(module: M, device: torch.device | str | None, dtype: torch.dtype | None) -> M:
    """A copy of a torch module on a device, in a precision; None: unchanged. Other objects are returned as they are.

    Raises `InputError` for a device that torch cannot use here, and for a type outside `PRECISIONS`.
    """
    if dtype not in (None, *PRECISIONS):
        raise InputError(f"dtype: expected one of {', '.join(map(str, PRECISIONS))}, found {dtype!r}")
    try:
        torch.empty(0, device=device)
    except (RuntimeError, AssertionError, TypeError) as error:
        found = f"{device!r}: {first_line(error)}"
        raise InputError(f"device: expected one that torch can use here, found {found}") from None
    return copy.deepcopy(module).to(device, dtype) if isinstance(module, nn.Module) else module
