"""The pages on the box: live view, alignment and the test bench."""
