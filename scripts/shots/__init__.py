"""One module a page; see scripts/screenshots.py."""
