"""Trains the small network and writes its weights and the ONNX model."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from bikeped.errors import DetectorError
from bikeped.lab.training.coco import CocoData
from bikeped.lab.training.crops import CropSettings
from bikeped.lab.training.export import export_network, training_record
from bikeped.lab.training.fit import FitSettings, fit
from bikeped.lab.training.hard_negative_mining import MiningSettings
from bikeped.lab.training.network import SmallDetector, save_weights


@dataclass(frozen=True)
class SmallTrainSettings:
    """Options of the command; the rest are `FitSettings`' defaults."""

    steps: int = 6000
    pictures: int = 8  #: per step
    seed: int = 0
    device: str = "auto"
    crops: CropSettings = field(default_factory=CropSettings)
    mining: MiningSettings = field(default_factory=MiningSettings)
    facts: dict[str, Any] = field(default_factory=dict)  #: recorded in weights and model


def train_small(
    data: CocoData,
    out: Path,
    order: SmallTrainSettings,
    progress: Callable[[int], None] = lambda done: None,
    say: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Writes `out`/weights.pt and `out`/model.onnx; returns a summary for JSON.

    Raises DataSetError and DetectorError.
    """
    device = resolve_device(order.device)
    on_cpu = device == "cpu"
    settings = FitSettings(
        steps=order.steps,
        pictures=order.pictures,
        warmup=min(100, max(1, order.steps // 10)),
        workers=2 if on_cpu and order.pictures % 2 == 0 else 1,
        seed=order.seed,
        bfloat16=supports_bfloat16(device),
        device=device,
        crops=order.crops,
        mining=order.mining,
    )
    fitted = fit(data, settings, progress, say)
    facts = order.facts | {"data_sha256": data.sha256, "steps": order.steps, "seed": order.seed}
    weights = out / "weights.pt"
    detector = SmallDetector(fitted.network, fitted.names, fitted.size, facts)
    save_weights(detector, weights)
    exported = export_network(detector, out / "model.onnx")
    return {
        "network": "small",
        **training_record(data, weights, exported),
        "seconds": round(fitted.seconds, 1),
        "device": device,
        "torch": torch.__version__,
        "settings": asdict(settings),
        "mistakes": fitted.mistakes,
        "losses": fitted.losses,
    }


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
