"""JSON Schemas of all messages, from the types in `schema`.

`python -m bikeped.telemetry.json_schema docs/messages` writes one file a message.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import msgspec

from bikeped.errors import BikepedError
from bikeped.files import make_folder, write_whole
from bikeped.telemetry import schema as messages

DIALECT = "https://json-schema.org/draft/2020-12/schema"

#: file name (before .schema.json) -> type of the payload
MESSAGES: dict[str, Any] = {
    "tracks": messages.TracksMessage,
    "state": messages.StateMessage,
    "health": messages.HealthMessage,
    "availability": messages.Availability,
    "event-header": messages.EventHeader,
    "event-frame": messages.EventLine,
}


def schema(name: str) -> dict[str, Any]:
    """The JSON Schema (draft 2020-12) of one message by its name in `MESSAGES`."""
    body = msgspec.json.schema(MESSAGES[name])
    return {"$schema": DIALECT, "title": f"bikeped {name}", **body}


def schema_files() -> dict[str, str]:
    """File name -> text of every schema."""
    return {
        f"{name}.schema.json": json.dumps(schema(name), indent=2, ensure_ascii=False) + "\n"
        for name in MESSAGES
    }


def main(arguments: list[str]) -> int:
    """Writes the schemas into the one directory named, creating it; returns the exit status."""
    if len(arguments) != 1:
        print("usage: python -m bikeped.telemetry.json_schema DIRECTORY", file=sys.stderr)
        return BikepedError.exit_status
    directory = Path(arguments[0])
    try:
        make_folder(directory, "directory")
        for name, text in schema_files().items():
            write_whole(directory / name, text)
            print(directory / name)
    except BikepedError as error:
        print(error, file=sys.stderr)
        return error.exit_status
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
