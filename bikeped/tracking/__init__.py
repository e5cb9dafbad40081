"""The bird's-eye-view tracker and the latency predictor. Pure: time is passed in."""

from bikeped.tracking.batch_tracker import BatchTracker, TrackerSettings
from bikeped.tracking.tracker import Tracker, predict

__all__ = ["BatchTracker", "Tracker", "TrackerSettings", "predict"]
