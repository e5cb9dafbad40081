"""Experiments on a suite of scenarios, with tables, figures and a report."""
