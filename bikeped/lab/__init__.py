"""Desk tools: simulation, experiments, calibration, training, test bench. Never on the pole."""
