"""Precision of forward passes."""

import torch


def computes_bfloat16(device: str) -> bool:
    """Whether a device ("cpu" or "cuda") multiplies in bfloat16 in hardware; emulation would be slower."""
    if device == "cuda":
        return torch.cuda.is_bf16_supported()
    capable = torch.cpu.get_capabilities()
    return bool(capable.get("avx512_bf16") or capable.get("amx_bf16"))
