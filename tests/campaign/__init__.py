"""The fault campaign: every fault of the list, injected against the real service.

`scripts/faults` runs it; `registry` holds the rows, `rig` what they run against. A row is one
small function that injects one fault and measures; its limits stand beside it and judge it.
"""
