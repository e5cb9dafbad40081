"""Training device: processor or GPU, and its support of bfloat16."""

from __future__ import annotations

from pathlib import Path

import torch

from bikeped.errors import DetectorError


def resolve_device(asked: str) -> str:
    """PyTorch's name of the device `auto`, `cpu`, or a GPU's number; DetectorError if unusable."""
    if asked == "auto":
        return "cuda" if torch.cuda.is_available() else "cpu"
    device = f"cuda:{asked}" if asked.isdigit() else asked
    try:
        torch.zeros(1, device=device)
    except (RuntimeError, AssertionError) as error:
        reason = " ".join(str(error).split())[:120]
        raise DetectorError(
            f"--device {asked}: cannot be used ({reason}); use cpu or auto"
        ) from error
    return device


def supports_bfloat16(device: str) -> bool:
    """Whether the device has bfloat16 hardware (of processors: AVX-512 BF16, AMX, Arm's BF16)."""
    if torch.device(device).type == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    try:
        flags = set(Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").split())
    except OSError:
        return False
    return bool(flags & {"avx512_bf16", "amx_bf16", "bf16"})
