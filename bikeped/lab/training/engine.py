"""Builds a TensorRT engine from an ONNX file, on the machine that will run it.

An engine fits one GPU and one TensorRT version, so it is built on the Jetson, with the system's
`tensorrt` package. The file begins with a header that `bikeped.detection` reads: four bytes of
length, little-endian, and that many bytes of JSON (as Ultralytics writes it).
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

from bikeped.detection.model_metadata import parse_metadata
from bikeped.errors import DetectorError
from bikeped.files import write_whole

_MB = 1 << 20
_OLDEST = 10  #: TensorRT's major version; JetPack 6 has 10


def build_engine(
    model: Path,
    out: Path,
    *,
    half: bool = True,
    workspace_mb: int = 2048,
    size: tuple[int, int] | None = None,
) -> dict[str, Any]:
    """Builds `out` from the ONNX file `model`, in minutes; returns a summary for JSON.

    `half` allows 16-bit floats where the GPU has fast ones; `workspace_mb` bounds the memory of the
    search. `size`: input width and height, for a model of any size; None: as its metadata say.
    Raises DetectorError.
    """
    trt = _tensorrt(out)
    try:
        content = model.read_bytes()
    except OSError as error:
        raise DetectorError(f"{model}: cannot be read ({error.strerror})") from error
    facts = onnx_facts(model)
    known = parse_metadata(facts, str(model))  # refuses what the loader would refuse
    logger = trt.Logger(trt.Logger.WARNING)
    builder = trt.Builder(logger)
    # TensorRT 10 has explicit batches only, without a flag.
    network = builder.create_network(0)
    parser = trt.OnnxParser(network, logger)
    if not parser.parse(content):
        reasons = [" ".join(str(parser.get_error(i)).split()) for i in range(parser.num_errors)]
        raise DetectorError(
            f"{model}: TensorRT {trt.__version__} does not understand it ({'; '.join(reasons)}); "
            "export with a lower opset"
        )
    config = builder.create_builder_config()
    _fix_size(network, builder, config, model, size, known.image_size)
    config.set_memory_pool_limit(trt.MemoryPoolType.WORKSPACE, workspace_mb * _MB)
    half = half and bool(builder.platform_has_fast_fp16)
    if half:
        config.set_flag(trt.BuilderFlag.FP16)
    plan = builder.build_serialized_network(network, config)
    if plan is None:
        raise DetectorError(
            f"{model}: TensorRT {trt.__version__} built no engine; its log says why. Free memory, "
            "or lower --workspace-mb"
        )
    header = json.dumps(facts).encode("utf-8")
    data = len(header).to_bytes(4, "little") + header + bytes(plan)
    write_whole(out, data)
    return {
        "engine": str(out),
        "from": str(model),
        "engine_bytes": len(data),
        "tensorrt": str(trt.__version__),
        "half_precision": half,
    }


def _fix_size(
    network: Any,
    builder: Any,
    config: Any,
    model: Path,
    asked: tuple[int, int] | None,
    known: tuple[int, int] | None,
) -> None:
    """Sets a dynamic input to the size asked for, else to the model's known one; a fixed input must
    have the size asked for."""
    taken = network.get_input(0)
    shape = list(taken.shape)
    if len(shape) != 4:
        return  # the loader says what is wrong with it
    if all(side > 0 for side in shape):
        if asked is not None and (shape[3], shape[2]) != asked:
            raise DetectorError(
                f"{model}: its input is {shape[3]} x {shape[2]}, not {asked[0]} x {asked[1]}; "
                "leave out --input, or export the model for any size"
            )
        return
    size = asked or known
    if size is None:
        raise DetectorError(
            f"{model}: takes pictures of any size and does not say which; name one with --input"
        )
    whole = (1, 3, size[1], size[0])
    profile = builder.create_optimization_profile()
    profile.set_shape(taken.name, whole, whole, whole)  # smallest, usual, largest
    config.add_optimization_profile(profile)


def onnx_facts(model: Path) -> dict[str, str]:
    """The metadata of an ONNX file; DetectorError where ONNX Runtime cannot load it."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    try:
        session = onnxruntime.InferenceSession(
            str(model), options, providers=["CPUExecutionProvider"]
        )
    except Exception as error:  # its errors share no class but this one
        reason = " ".join(str(error).split())[:200]
        raise DetectorError(f"{model}: is no ONNX model that can be loaded ({reason})") from error
    return dict(sorted(session.get_modelmeta().custom_metadata_map.items()))


def _tensorrt(out: Path) -> Any:
    try:
        trt = importlib.import_module("tensorrt")
    except ImportError as error:
        raise DetectorError(
            f"{out}: building an engine needs the system's `tensorrt` package ({error}); do it on "
            "the Jetson, in a virtual environment made with --system-site-packages"
        ) from error
    major = str(trt.__version__).split(".", 1)[0]
    if not major.isdigit() or int(major) < _OLDEST:
        raise DetectorError(
            f"{out}: TensorRT {trt.__version__} is too old; {_OLDEST} or later is needed "
            "(JetPack 6)"
        )
    return trt
