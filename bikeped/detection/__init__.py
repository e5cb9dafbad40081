"""Pictures in, road users out: the network, its layouts, and the rider-on-a-cycle rule."""

from bikeped.detection.base import Detector, DetectorAnswer
from bikeped.detection.load import load_detector

__all__ = ["Detector", "DetectorAnswer", "load_detector"]
