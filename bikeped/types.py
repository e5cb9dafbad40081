"""One small frozen type a stage: frame, detections, ground points, tracks, decision.

Times are seconds on the machine's monotonic clock (`*_s`), pixels are sensor pixels unless a name
says otherwise, positions are metres in the camera ground frame (x forward, y right, origin on the
ground below the lens). Arrays are parallel; constructors raise ValueError for a wrong shape.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from bikeped.faults import Fault
from bikeped.lamp.colours import Colour as Colour

FloatArray = npt.NDArray[np.float64]
Float32Array = npt.NDArray[np.float32]
IntArray = npt.NDArray[np.int64]
KindArray = npt.NDArray[np.int8]
BoolArray = npt.NDArray[np.bool_]
ImageArray = npt.NDArray[np.uint8]


class Kind(enum.IntEnum):
    """Kind of road user; its value is the code in `kind` arrays."""

    PEDESTRIAN = 0
    CYCLIST = 1
    VEHICLE = 2

    @property
    def label(self) -> str:
        """The word used in files and messages: `pedestrian`, `cyclist`, `vehicle`."""
        return self.name.lower()


class State(enum.IntEnum):
    """The decision's four output states (paper, table 2), in order of urgency."""

    IDLE = 0
    SAFE = 1
    WARNING = 2
    ALERT = 3


@dataclass(frozen=True)
class Frame:
    """One camera image, undecoded where the camera encodes it.

    Exactly one of `jpeg` (a whole JPEG file) and `rgb` (height x width x 3, uint8) is set.
    """

    number: int  #: counts every frame that the source delivered, dropped ones included
    captured_s: float  #: capture time; monotonic for a live camera, media time for a recording
    width: int  #: of the full frame, in pixels
    height: int
    jpeg: bytes | memoryview | None = None
    rgb: ImageArray | None = None

    def __post_init__(self) -> None:
        if (self.jpeg is None) == (self.rgb is None):
            raise ValueError("a Frame holds either jpeg or rgb, not both and not neither")


@dataclass(frozen=True)
class Region:
    """The part of a frame that the detector sees, as shares of its width and height.

    `aspect` is the whole frame's width over its height. Scaled copies of a frame have the same
    region. Raises ValueError for one without area.
    """

    left: float
    top: float
    right: float
    bottom: float
    aspect: float

    def __post_init__(self) -> None:
        across = 0 <= self.left < self.right <= 1
        if not (across and 0 <= self.top < self.bottom <= 1 and self.aspect > 0):
            raise ValueError(f"not a part of a frame: {self}")

    def pixels(self, width_px: int, height_px: int) -> tuple[int, int, int, int]:
        """First column and row, and those after the last, in a copy of the frame of this size."""
        u1 = min(round(self.left * width_px), width_px - 1)
        v1 = min(round(self.top * height_px), height_px - 1)
        u2, v2 = round(self.right * width_px), round(self.bottom * height_px)
        return u1, v1, max(u2, u1 + 1), max(v2, v1 + 1)


@dataclass(frozen=True)
class Detections:
    """Detections in one frame, most confident first.

    `kind` [n] int8 codes of `Kind`; `confidence` [n] in 0..1; `box_px` [n, 4] as u1, v1, u2, v2
    in pixels of the full frame; `ridden` [n], cycles with a rider's box (None: not known).
    """

    kind: KindArray
    confidence: Float32Array
    box_px: Float32Array
    ridden: BoolArray | None = None

    def __post_init__(self) -> None:
        n = len(self.kind)
        _check_shapes(self, kind=(n,), confidence=(n,), box_px=(n, 4), ridden=(n,))

    def __len__(self) -> int:
        return len(self.kind)

    @staticmethod
    def empty() -> Detections:
        return Detections(
            np.zeros(0, np.int8), np.zeros(0, np.float32), np.zeros((0, 4), np.float32)
        )

    def take(self, index: npt.NDArray[Any]) -> Detections:
        """The detections at `index` (integers or a mask), in that order."""
        ridden = None if self.ridden is None else self.ridden[index]
        return Detections(self.kind[index], self.confidence[index], self.box_px[index], ridden)

    def bottom_centre_px(self) -> FloatArray:
        """[n, 2] u, v of the middle of each lower edge, which is projected onto the ground."""
        box = self.box_px.astype(np.float64)
        return np.stack([(box[:, 0] + box[:, 2]) / 2, box[:, 3]], axis=1)


@dataclass(frozen=True)
class GroundPoints:
    """Detections on the ground: `kind` [n], `xy_m` [n, 2], `detection` [n] their index, `ridden`
    and `confidence` [n] as in `Detections` (None: not known)."""

    kind: KindArray
    xy_m: FloatArray
    detection: IntArray
    ridden: BoolArray | None = None
    confidence: Float32Array | None = None

    def __post_init__(self) -> None:
        n = len(self.kind)
        _check_shapes(self, xy_m=(n, 2), detection=(n,), ridden=(n,), confidence=(n,))

    def __len__(self) -> int:
        return len(self.kind)

    def take(self, index: IntArray) -> GroundPoints:
        """The points at `index`, in that order."""
        ridden = None if self.ridden is None else self.ridden[index]
        confidence = None if self.confidence is None else self.confidence[index]
        return GroundPoints(
            self.kind[index], self.xy_m[index], self.detection[index], ridden, confidence
        )


@dataclass(frozen=True)
class Tracks:
    """The road users tracked at `time_s`, oldest first (ascending id).

    `id` [n]; `kind` [n]; `xy_m` [n, 2]; `velocity_mps` [n, 2]; `unseen_s` [n], 0 when matched in
    this frame; `detection` [n], index of the matched detection in this frame or -1.
    """

    time_s: float
    id: IntArray
    kind: KindArray
    xy_m: FloatArray
    velocity_mps: FloatArray
    unseen_s: FloatArray
    detection: IntArray

    def __post_init__(self) -> None:
        n = len(self.id)
        _check_shapes(
            self, kind=(n,), xy_m=(n, 2), velocity_mps=(n, 2), unseen_s=(n,), detection=(n,)
        )

    def __len__(self) -> int:
        return len(self.id)

    def take(self, index: npt.NDArray[Any]) -> Tracks:
        """The tracks at `index` (integers or a mask), in that order."""
        _, *arrays = vars(self).values()
        return Tracks(self.time_s, *(array[index] for array in arrays))

    @staticmethod
    def empty(time_s: float) -> Tracks:
        none, flat = np.zeros(0, np.int64), np.zeros((0, 2))
        return Tracks(time_s, none, np.zeros(0, np.int8), flat, flat, np.zeros(0), none)


@dataclass(frozen=True)
class PairMetrics:
    """The measurements of one cyclist-pedestrian pair that the rule compares."""

    cyclist_id: int
    pedestrian_id: int
    distance_m: float
    distance_then_m: float  #: at the start of the lookback
    lookback_s: float
    displacement_m: float  #: of the cyclist over the lookback
    speed_mps: float  #: of the cyclist
    d_min_m: float
    d_max_m: float  #: at least the stopping distance where `decision.speed_adaptive` is on
    closing_mps: float = 0.0  #: how fast the distance shrinks, by the filter's velocities
    pass_m: float = 0.0  #: least distance within the next 5 s, if both go on as now
    pass_s: float = 0.0  #: when
    contact_s: float = math.inf  #: until contact at this closing speed


@dataclass(frozen=True)
class Decision:
    """The state at `time_s`, with the reason in one line for a resident, and in `detail` the test's
    numbers.

    `raw` is the rule's own state of this frame, `state` what is shown of it: ALERT only when the
    rule is sure of it, and then for a while (definitions, section 14).
    """

    time_s: float
    state: State
    sentence: str
    pair: PairMetrics | None = None  #: the first that fires (ALERT) or the nearest (WARNING)
    raw: State | None = None  #: None: as shown
    detail: str = ""

    @property
    def held(self) -> bool:
        """Whether ALERT is shown for an earlier frame's sake."""
        return self.state is State.ALERT and self.raw not in (None, State.ALERT)


class Sound(str, enum.Enum):
    """Sounds of the speaker."""

    NONE = "none"
    CHIME = "chime"
    BELL = "bell"


@dataclass(frozen=True)
class Signal:
    """The light and sound that road users perceive."""

    name: str  #: IDLE, SAFE, WARNING, ALERT, FAULT or OFF
    colour: Colour
    blink_hz: float = 0.0  #: 0 is steady
    sound: Sound = Sound.NONE
    faults: tuple[Fault, ...] = ()  #: what is wrong now; not empty when the signal is FAULT


def _check_shapes(owner: object, **shapes: tuple[int, ...]) -> None:
    for name, shape in shapes.items():
        array = getattr(owner, name)
        if array is not None and array.shape != shape:
            raise ValueError(
                f"{type(owner).__name__}.{name}: expected shape {shape}, got {array.shape}"
            )
