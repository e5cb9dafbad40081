"""Where a decision section came from: the file that `conformance promote` leaves beside it.

It guards against mistakes (a key edited by hand, a new calibration, an upgrade), not against a
person who may write both files: nothing is signed.
"""

from __future__ import annotations

import ast
import functools
import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from bikeped import __version__
from bikeped.config.load import LoadedConfig
from bikeped.config.schema import DecisionConfig
from bikeped.files import read_regular
from bikeped.models import model_file, model_sha256

#: What turns detections into a state on the pole; the simulation runs the same rule and tracker.
DECIDING_CODE = ("config/build", "decision", "geometry", "pipeline/track_and_decide", "tracking")
#: What the figures of a promotion were measured with.
MEASURING_CODE = ("lab/scenarios", "lab/simulation", "lab/experiments", "lab/governance")

#: Keys of the camera section that place no pixel on the ground; all others count as geometry. Of
#: the calibration its content counts, not its name.
_CAPTURE_KEYS = (
    *("source", "username", "password_file", "fps", "fourcc", "stale_after_s", "hang_after_s"),
    "calibration",
)
#: What the hashes of a provenance cover, in words.
_COVERED = {
    "tracking_hash": "the tracking section",
    "latency_hash": "the latency section",
    "camera_hash": "the camera or its calibration",
    "detector_hash": "the detector",
}


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """What the service reads of `config.provenance.json`; further keys are for people.

    A hash that is None was not yet written by the version that promoted.
    """

    promoted_at: str
    decision_hash: str
    tracking_hash: str | None = None
    latency_hash: str | None = None
    camera_hash: str
    detector_hash: str | None = None
    suite_hash: str
    code_hash: str
    version: str
    scenarios: int
    metrics: dict[str, float | int | None] = {}


@dataclass(frozen=True)
class ProvenanceCheck:
    """`holds`: the decision in force is the promoted one, measured with all that decides now."""

    holds: bool
    text: str


def provenance_path(config: Path) -> Path:
    """The file beside a configuration: `config.yaml` has `config.provenance.json`."""
    return config.with_name(f"{config.stem}.provenance.json")


def decision_hash(decision: DecisionConfig) -> str:
    """SHA-256 over every effective value of the section, however it was written."""
    return _sha256(decision)


def setting_hashes(loaded: LoadedConfig) -> dict[str, str]:
    """SHA-256 of each part of the configuration that decides, by its key in a provenance.

    The detector counts by its model file (or `detection.sha256` where the file is not there) and
    by what its classes stand for. Raises OSError when the model file cannot be read.
    """
    config, detection = loaded.config, loaded.config.detection
    camera = msgspec.structs.asdict(config.camera)
    model_hash = detection.sha256 and detection.sha256.lower()
    file = None if detection.model is None else model_file(detection.model, loaded.base_dir)
    if file is not None and file.is_file():
        model_hash = model_sha256(file)
    kinds = (detection.pedestrian, detection.cyclist, detection.vehicle)
    return {
        "decision_hash": decision_hash(config.decision),
        "tracking_hash": _sha256(config.tracking),
        "latency_hash": _sha256(config.latency),
        "camera_hash": _sha256(
            [{k: v for k, v in camera.items() if k not in _CAPTURE_KEYS}, loaded.calibration_hash]
        ),
        "detector_hash": _sha256([model_hash, kinds]),
    }


def _sha256(value: Any) -> str:
    return hashlib.sha256(msgspec.json.encode(value, order="deterministic")).hexdigest()


@functools.cache
def code_hash(packages: tuple[str, ...] = DECIDING_CODE, root: Path | None = None) -> str:
    """SHA-256 over what parts of bikeped (packages or modules) do: their names and syntax trees.

    Comments, docstrings and layout do not count, nor does the Python version. `root`: the folder of
    the package; None: bikeped's own.
    """
    root = root or Path(__file__).parent.parent
    digest = hashlib.sha256()
    for package in sorted(packages):
        folder = root / package
        files = sorted(folder.rglob("*.py")) if folder.is_dir() else [root / f"{package}.py"]
        for file in files:
            tree = _tree_text(ast.parse(file.read_bytes()))
            digest.update(f"{file.relative_to(root).as_posix()} {len(tree)}\n{tree}".encode())
    return digest.hexdigest()


def _tree_text(node: Any) -> str:
    """A syntax tree as text, without docstrings and without what is empty: later versions of Python
    add fields that are empty for the same source."""
    if isinstance(node, list):
        return f"[{','.join(map(_tree_text, node))}]"
    if not isinstance(node, ast.AST):
        return repr(node)
    fields = dict(ast.iter_fields(node))
    if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)):
        has_docstring = ast.get_docstring(node, clean=False) is not None
        fields["body"] = node.body[1:] if has_docstring else node.body
    given = (f"{k}={_tree_text(v)}" for k, v in fields.items() if v is not None and v != [])
    return f"{type(node).__name__}({','.join(given)})"


def check_provenance(loaded: LoadedConfig) -> ProvenanceCheck:
    """Compares the configuration in force with its provenance. Never raises: it is for a log."""
    path = provenance_path(Path(loaded.source))
    try:
        found = msgspec.json.decode(read_regular(path), type=Provenance)
    except FileNotFoundError:
        return ProvenanceCheck(
            False, f"decision: no provenance ({path.name} is not there): it was never promoted"
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
    text = (
        f"decision promoted {found.promoted_at}, suite {found.suite_hash[:12]} "
        f"({found.scenarios} scenarios), sensitivity {_figure(found, 'sensitivity', '{:.1%}')}, "
        f"specificity {_figure(found, 'specificity', '{:.1%}')}, "
        f"warning budget {_figure(found, 'mean_warning_budget_s', '{:.2f} s')}"
    )
    if None in (found.tracking_hash, found.latency_hash, found.detector_hash):
        return ProvenanceCheck(
            False,
            f"{text}; but bikeped {found.version} did not record tracking, latency and detector: "
            "promote again",
        )
    try:
        now = setting_hashes(loaded)
        changed = [what for key, what in _COVERED.items() if now[key] != getattr(found, key)]
        if code_hash() != found.code_hash:
            changed.append(f"the deciding code ({found.version}, now {__version__})")
    except OSError as error:
        changed = [f"something that cannot be read now ({' '.join(str(error).split())})"]
    if changed:
        text += f"; but {' and '.join(changed)} changed since: promote again"
    return ProvenanceCheck(not changed, text)


def _figure(found: Provenance, key: str, form: str) -> str:
    value = found.metrics.get(key)
    return "unknown" if value is None else form.format(value)
