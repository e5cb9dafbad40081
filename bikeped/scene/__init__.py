"""Scenarios as fisheye pictures with exact labels: a known world for the chain from pixels on."""
