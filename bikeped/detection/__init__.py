"""Road-user detection: frames to boxes of pedestrians, cyclists and vehicles."""

from bikeped.detection.base import DetectionResult, Detector
from bikeped.detection.load import load_detector

__all__ = ["DetectionResult", "Detector", "load_detector"]
