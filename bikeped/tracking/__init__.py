"""The bird's-eye-view tracker and the latency predictor. Pure: time is passed in."""
