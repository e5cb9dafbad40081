"""Rows that nothing here injects, and what closes them."""

from __future__ import annotations

from campaign.registry import EVIDENCE, HARDWARE, WORLD, Row, add, limits

for number, injected, expected, limit, closed_by in (
    (44, "a line of the audit log edited or deleted", "the hash chain breaks",
     "first bad record found >= 100 %", EVIDENCE),
    (49, "the camera comes back as another /dev/videoN", "found again by a stable name",
     "ready <= 5 s", HARDWARE),
    (52, "an AVI that states 0 frames/s, raw H.264", "asks for the rate",
     "wrong speeds = 0", WORLD),
    (53, "a model without a cyclist or pedestrian class; boxes in 0..1", "refused at the start",
     "refused >= 100 %", WORLD),
    (55, "JPEG with a few bytes before a restart marker", "decoded, as OpenCV does",
     "decoded >= 100 %", WORLD),
    (56, "an H.264 stream changes size or aspect", "FAULT", "FAULT <= 1 s", WORLD),
):  # fmt: skip
    add(Row(number, injected, expected, limits(limit), closed_by=closed_by))
