"""Pictures in, road users out: the network, its layouts, and the rider-on-a-cycle rule."""

from bikeped.detection.base import DetectionResult, Detector
from bikeped.detection.load import load_detector

__all__ = ["DetectionResult", "Detector", "load_detector"]
