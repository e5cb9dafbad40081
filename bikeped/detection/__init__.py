"""Road-user detection: frames to boxes of pedestrians, cyclists and vehicles."""

from bikeped.detection.base import DetectionResult, Detector, load_detector

__all__ = ["DetectionResult", "Detector", "load_detector"]
