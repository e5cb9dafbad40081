"""Conformance from pixels: drawn scenarios through the deployed loop, compared with the truth."""
