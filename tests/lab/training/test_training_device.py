"""Which device is trained on, and whether 16 bits are quicker there."""

from __future__ import annotations

from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'bikeped[train]'")

from bikeped.errors import DetectorError  # noqa: E402
from bikeped.lab.training import small  # noqa: E402


def test_auto_is_a_device_that_is_there():
    assert small.resolve_device("auto") == ("cuda" if torch.cuda.is_available() else "cpu")


def test_a_device_that_is_not_there_is_one_line_with_the_mend():
    with pytest.raises(DetectorError, match=r"--device 99: cannot be used \(.*\); use cpu or auto"):
        small.resolve_device("99")


@pytest.mark.parametrize(
    ("flags", "known"),
    [
        ("flags : fpu avx512f avx512_bf16 avx512_vnni", True),
        ("flags : fpu amx_bf16 amx_tile", True),
        ("Features : fp asimd bf16 i8mm", True),
        ("flags : fpu avx2 avx512f", False),
        ("flags : fpu avx512_bf16x", False),
    ],
)
def test_sixteen_bits_are_for_processors_that_multiply_them(monkeypatch, tmp_path, flags, known):
    listed = tmp_path / "cpuinfo"
    listed.write_text(f"processor : 0\n{flags}\n", encoding="ascii")
    monkeypatch.setattr(small, "Path", lambda _: listed)
    assert small.supports_bfloat16("cpu") is known


def test_where_nothing_lists_the_processor_it_is_float32(monkeypatch, tmp_path):
    monkeypatch.setattr(small, "Path", lambda _: Path(tmp_path) / "none")
    assert small.supports_bfloat16("cpu") is False
