"""The last configuration that ran well, kept so that a broken file does not end the service.

In the service's state folder, `last-good` is a link to a folder with `config.yaml`, the calibration
that it names as `camera_calibration.json`, and its provenance. The link is changed last and in one
step, so a loss of power leaves the old copy or the new one. Put the copy back with
`cp STATE/last-good/config.yaml /etc/bikeped/`.
"""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from bikeped.config.load import LoadedConfig, load_config, parse_config
from bikeped.config.provenance import provenance_path
from bikeped.config.runnable import check_runnable, is_complete
from bikeped.config.strict_yaml import read_text
from bikeped.errors import BikepedError, ConfigError
from bikeped.files import read_regular, sync_folder, whole_folder, write_synced

_CONFIG, _CALIBRATION = "config.yaml", "camera_calibration.json"


class LastGood:
    """The copy in the folder `folder`."""

    def __init__(self, folder: Path) -> None:
        self.folder, self._link = folder, folder / "last-good"

    def keep(self, loaded: LoadedConfig) -> None:
        """Copies what `loaded` was read from, and removes older copies. Raises OSError."""
        files = {_CONFIG: loaded.text.encode()}
        if loaded.calibration_data is not None:
            files[_CALIBRATION] = loaded.calibration_data
        provenance = provenance_path(Path(loaded.source))
        if provenance.is_file():
            files[provenance_path(Path(_CONFIG)).name] = read_regular(provenance)
        digest = hashlib.sha256(b"\0".join(files.values())).hexdigest()[:16]
        target = self.folder / f"kept-{digest}"
        if not target.is_dir():
            with whole_folder(target) as partial:
                for name, data in files.items():
                    write_synced(partial / name, data, mode=0o444)
                sync_folder(partial)
        link = self.folder / ".last-good.new"
        link.unlink(missing_ok=True)
        link.symlink_to(target.name)
        sync_folder(self.folder)
        os.replace(link, self._link)  # noqa: PTH105 - a Path would follow the link
        sync_folder(self.folder)
        for old in self.folder.glob("kept-*"):
            if old != target:
                shutil.rmtree(old, ignore_errors=True)

    def load(self, config_path: Path, overrides: Sequence[str] = ()) -> LoadedConfig | None:
        """The copy, with paths relative to the folder of `config_path`; None where it is unusable.

        A copy ran before, so it cannot be broken but by damage.
        """
        folder = self._link.resolve()
        calibration = folder / _CALIBRATION
        try:
            text = read_text(folder / _CONFIG, "")
            loaded = parse_config(
                text,
                str(self._link / _CONFIG),
                config_path.parent,
                overrides,
                calibration if calibration.is_file() else None,
            )
            check_runnable(loaded)
        except BikepedError:
            return None
        return loaded


def load_runnable(
    path: Path, overrides: Sequence[str] = (), last_good: LoadedConfig | None = None
) -> LoadedConfig:
    """The configuration for `run`. Raises BikepedError with one line where it cannot be run, or
    where it lacks the `complete: true` that `last_good` has: it was cut off."""
    loaded = load_config(path, overrides)
    check_runnable(loaded)
    if last_good is not None and is_complete(last_good) and not is_complete(loaded):
        raise ConfigError(
            f"{path}: complete: missing, which the last good configuration had: the file was cut "
            "off; write its end anew, with complete: true as the last line"
        )
    return loaded
