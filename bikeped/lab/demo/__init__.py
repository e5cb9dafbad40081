"""The demonstration: a scripted crossing, and the summary of its replay."""
