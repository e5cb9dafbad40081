"""Where a decision section came from: the file that `conformance promote` leaves beside it.

It stands against mistakes (a key edited by hand, a new calibration, an upgrade), not against a
person who may write both files: nothing is signed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from bikeped import __version__
from bikeped.config.build import ground_camera
from bikeped.config.load import LoadedConfig
from bikeped.config.schema.decision import DecisionConfig
from bikeped.errors import BikepedError

#: What turns positions into a state on the pole; the simulation runs the very same code.
DECIDING_CODE = ("decision", "geometry", "tracking")
#: What the figures of a promotion were measured with.
MEASURING_CODE = ("lab/scenarios", "lab/simulation", "lab/experiments", "lab/governance")


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """What the service reads of `config.provenance.json`; further keys are for people."""

    promoted_at: str
    decision_hash: str
    suite_hash: str
    camera_hash: str
    code_hash: str
    version: str
    scenarios: int
    metrics: dict[str, float | int | None] = {}


@dataclass(frozen=True)
class ProvenanceCheck:
    """`holds`: the decision in force is the promoted one, measured with this camera and code."""

    holds: bool
    text: str


def provenance_path(config: Path) -> Path:
    """The file beside a configuration: `config.yaml` has `config.provenance.json`."""
    return config.with_name(f"{config.stem}.provenance.json")


def decision_hash(decision: DecisionConfig) -> str:
    """SHA-256 over every effective value of the section, however it was written."""
    return hashlib.sha256(msgspec.json.encode(decision, order="deterministic")).hexdigest()


def camera_hash(loaded: LoadedConfig) -> str:
    """SHA-256 over what places a pixel on the ground: lens, centre, height, pitch, heading."""
    camera = ground_camera(loaded)
    lens = camera.lens
    values = (
        lens.projection,
        lens.focal_px,
        list(lens.k),
        lens.max_theta_rad,
        camera.cx,
        camera.cy,
        camera.height_m,
        camera.pitch_deg,
        camera.heading_deg,
        camera.window_px,
    )
    return hashlib.sha256(msgspec.json.encode(values)).hexdigest()


def code_hash(packages: Iterable[str] = DECIDING_CODE) -> str:
    """SHA-256 over the sources of parts of bikeped (packages or modules), names and contents."""
    root = Path(__file__).parent.parent
    digest = hashlib.sha256()
    for package in sorted(packages):
        folder = root / package
        files = sorted(folder.glob("*.py")) if folder.is_dir() else [root / f"{package}.py"]
        for file in files:
            content = file.read_bytes()
            digest.update(f"{package}/{file.name} {len(content)}\n".encode())
            digest.update(content)
    return digest.hexdigest()


def check_provenance(loaded: LoadedConfig) -> ProvenanceCheck:
    """Holds the configuration in force against its provenance. Never raises: it is for a log."""
    path = provenance_path(Path(loaded.source))
    try:
        found = msgspec.json.decode(path.read_bytes(), type=Provenance)
    except FileNotFoundError:
        return ProvenanceCheck(
            False, f"decision: no provenance ({path.name} is not there); nobody promoted it"
        )
    except (OSError, msgspec.DecodeError, UnicodeDecodeError) as error:
        what = " ".join(str(error).split())
        return ProvenanceCheck(False, f"decision: provenance {path.name} is unreadable ({what})")
    if decision_hash(loaded.config.decision) != found.decision_hash:
        return ProvenanceCheck(
            False,
            f"decision section differs from the promoted one of {found.promoted_at}: its measured "
            "figures do not hold; promote it, or put the promoted section back",
        )
    doubts = []
    try:
        if camera_hash(loaded) != found.camera_hash:
            doubts.append("the camera or its calibration is another one now")
        if code_hash() != found.code_hash:
            doubts.append(f"the deciding code is another one now ({found.version}, {__version__})")
    except (BikepedError, OSError) as error:
        doubts.append(f"camera and code cannot be compared ({' '.join(str(error).split())})")
    text = (
        f"decision promoted {found.promoted_at}, suite {found.suite_hash[:12]} "
        f"({found.scenarios} scenarios), sensitivity {_percent(found, 'sensitivity')}, specificity "
        f"{_percent(found, 'specificity')}, warning budget {_seconds(found)}"
    )
    if doubts:
        text += "; but " + " and ".join(doubts) + ": run bikeped conformance gate again"
    return ProvenanceCheck(not doubts, text)


def _percent(found: Provenance, key: str) -> str:
    value = found.metrics.get(key)
    return "unknown" if value is None else f"{100 * value:.1f} %"


def _seconds(found: Provenance) -> str:
    value = found.metrics.get("mean_warning_budget_s")
    return "unknown" if value is None else f"{value:.2f} s"
