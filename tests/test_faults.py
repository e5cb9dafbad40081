"""The table of faults: complete and consistent."""

from __future__ import annotations

from pathlib import Path

import pytest

from bikeped.faults import EXIT_RESTART, FAULT_KINDS, Clears, Effect, Fault, Severity, fault_texts

SOURCE = Path(__file__).parents[1] / "bikeped"


@pytest.mark.parametrize("kind", FAULT_KINDS.values(), ids=FAULT_KINDS)
def test_every_row_is_consistent(kind):
    prefix = kind.code.partition(".")[0]
    assert {"lamp": "light"}.get(prefix, prefix) == kind.component
    assert kind.meaning.endswith(".")
    assert (kind.exit_status is None) or (
        kind.exit_status == EXIT_RESTART
        and kind.effect is Effect.FAULT
        and kind.severity is Severity.CRITICAL
        and kind.clears is Clears.RESTART
    )
    # Only evidence from frames ends a fault of the frames' own way.
    if kind.component in ("camera", "detector", "service") and kind.exit_status is None:
        assert (kind.effect, kind.clears) in (
            (Effect.FAULT, Clears.GOOD_FRAMES),
            (Effect.WITHHELD, Clears.AT_ONCE),
            (Effect.NOTICE, Clears.AT_ONCE),
        )


def test_a_code_that_the_table_lacks_is_refused():
    with pytest.raises(ValueError, match=r"camera\.lens_wet.*FAULT_KINDS"):
        Fault("camera", "camera.lens_wet", "drops on the lens")


def test_a_fault_reads_as_source_and_detail():
    fault = Fault("camera", "camera.no_frame", "no frame yet")
    assert str(fault) == "camera: no frame yet"
    assert fault_texts([fault, fault]) == ("camera: no frame yet",) * 2
    assert fault.kind is FAULT_KINDS["camera.no_frame"]


def test_no_code_reads_the_text_of_a_fault_again():
    """What a fault is stands in its code: no prefix of a text may decide anything."""
    words = {kind.component for kind in FAULT_KINDS.values()} | {"geometry", "recovering"}
    for file in SOURCE.rglob("*.py"):
        for line in file.read_text(encoding="utf-8").splitlines():
            if "startswith" in line:
                assert not any(f'"{word}' in line for word in words), f"{file}: {line.strip()}"
