"""The conformance simulation: scripted hazards through the deployed tracker and rules."""
