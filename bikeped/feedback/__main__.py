"""`python -m bikeped.feedback CONFIG`: darkens the light that a dead service left on.

systemd runs this after the service has ended for whatever reason (ExecStopPost in
deploy/bikeped.service). A relay board or a USB light keeps its last colour when the process that
set it is killed, and a green light of a dead service is the worst that this light can do. Dark is
the one answer that claims nothing; when the service comes up again it starts in FAULT.

Only the section `feedback` of the file is read: a mistake elsewhere must not keep a light on.
Ends with 0 when the light is dark, 2 when it cannot be reached.
"""

from __future__ import annotations

import sys
from pathlib import Path

import msgspec

from bikeped.config.output_sections import FeedbackConfig
from bikeped.errors import BikepedError, ConfigError
from bikeped.feedback import open_light
from bikeped.files import read_regular


class _FeedbackOnly(msgspec.Struct):
    """A configuration of which only the light matters."""

    feedback: FeedbackConfig = msgspec.field(default_factory=FeedbackConfig)


def main(arguments: list[str]) -> int:
    """Opens the light named in the configuration file `arguments[0]` and closes it again."""
    if len(arguments) != 1:
        sys.stderr.write("usage: python -m bikeped.feedback CONFIG\n")
        return 2
    try:
        data = read_regular(Path(arguments[0]))
        feedback = msgspec.yaml.decode(data, type=_FeedbackOnly).feedback
        if feedback.light != "lamp":  # whose process shows FAULT by itself
            open_light(feedback).close()
    except BikepedError as error:
        sys.stderr.write(f"{error}\n")
        return error.exit_status
    except (OSError, msgspec.DecodeError) as error:
        sys.stderr.write(f"{arguments[0]}: {error}\n")
        return ConfigError.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
