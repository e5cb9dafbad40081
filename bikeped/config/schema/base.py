"""What all sections of the configuration share."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec


class Section(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=False
):
    """Base of all sections: immutable, no unknown keys."""


def sections(
    struct: type[msgspec.Struct], path: str = ""
) -> Iterator[tuple[str, type[msgspec.Struct]]]:
    """(path, section) of a section (its own path is `path`) and of all sections in it, in order."""
    yield path, struct
    for field in msgspec.structs.fields(struct):
        if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            yield from sections(field.type, f"{path}.{field.name}" if path else field.name)
