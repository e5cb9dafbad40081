"""Scenario files: scripted encounters of road users, 24 of them bundled."""
