"""Lens, camera, framing and ground table: pixels to metres and back; box overlap. Pure."""
