"""What all sections of the configuration share."""

from __future__ import annotations

import msgspec


class Section(
    msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=False
):
    """Base of all sections: immutable, no unknown keys."""
