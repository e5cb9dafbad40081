"""Road-user detection: frames to boxes of pedestrians, cyclists and vehicles."""
