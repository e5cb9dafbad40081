"""The walk through an ONNX file to its first convolution."""

from __future__ import annotations

import numpy as np
import onnx
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from onnx import TensorProto, helper, numpy_helper

from bikeped.detection.weights import first_gain, trained_on_bytes
from bikeped.errors import DetectorError

WEIGHTS = np.random.default_rng(0).normal(0, 1, (8, 12, 3, 3)).astype(np.float32)
GAIN = float(np.sqrt((WEIGHTS.astype(np.float64) ** 2).sum() / 8))


def save(path, nodes, arrays):
    graph = helper.make_graph(
        nodes,
        "test",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, 64, 64))],
        [helper.make_tensor_value_info("y", TensorProto.FLOAT, None)],
        [
            a if isinstance(a, TensorProto) else numpy_helper.from_array(a, n)
            for n, a in arrays.items()
        ],
    )
    onnx.save(helper.make_model(graph), path)
    return path


def focus_and_conv(weights_name="w"):
    """YOLOX's first steps: space to depth by slices, joined, then the convolution."""
    return [
        helper.make_node("Slice", ["images", "a", "b"], ["p"]),
        helper.make_node("Slice", ["images", "a", "b"], ["q"]),
        helper.make_node("Concat", ["p", "q"], ["x"], axis=1),
        helper.make_node("Conv", ["x", weights_name], ["y"]),
    ]


INDICES = {"a": np.array([0]), "b": np.array([64])}


@pytest.mark.parametrize("dtype", [np.float32, np.float16, np.float64])
def test_gain_through_the_focus_layer(tmp_path, dtype):
    path = save(tmp_path / "m.onnx", focus_and_conv(), {"w": WEIGHTS.astype(dtype), **INDICES})
    first = first_gain(path)
    assert first is not None
    assert first == pytest.approx(GAIN, rel=1e-3)
    assert trained_on_bytes(first) is False


def test_weights_without_raw_data_and_as_a_constant_node(tmp_path):
    typed = helper.make_tensor("w", TensorProto.FLOAT, WEIGHTS.shape, WEIGHTS.ravel().tolist())
    path = save(tmp_path / "a.onnx", focus_and_conv(), {"w": typed, **INDICES})
    assert first_gain(path) == pytest.approx(GAIN, rel=1e-6)
    constant = helper.make_node("Constant", [], ["w"], value=numpy_helper.from_array(WEIGHTS))
    path = save(tmp_path / "b.onnx", [constant, *focus_and_conv()], INDICES)
    assert first_gain(path) == pytest.approx(GAIN, rel=1e-6)


def test_batch_normalisation_that_was_not_folded_counts(tmp_path):
    nodes = focus_and_conv()
    nodes[-1].output[0] = "c"
    nodes.append(
        helper.make_node("BatchNormalization", ["c", "s", "o", "m", "v"], ["y"], epsilon=0.25)
    )
    ones = np.ones(8, np.float32)
    arrays = {"w": WEIGHTS, "s": 3 * ones, "o": ones, "m": ones, "v": 8.75 * ones, **INDICES}
    first = first_gain(save(tmp_path / "m.onnx", nodes, arrays))
    assert first == pytest.approx(GAIN, rel=1e-5)  # 3 / sqrt(8.75 + 0.25)


@pytest.mark.parametrize(("scale", "verdict"), [(1, False), (1 / 57, True), (0.07, None)])
def test_the_verdict(tmp_path, scale, verdict):
    weights = (WEIGHTS * scale).astype(np.float32)
    first = first_gain(save(tmp_path / "m.onnx", focus_and_conv(), {"w": weights, **INDICES}))
    assert trained_on_bytes(first) is verdict


def test_arithmetic_before_the_convolution_and_unreadable_weights_are_not_judged(tmp_path):
    scaled = [
        helper.make_node("Div", ["images", "d"], ["x"]),
        helper.make_node("Conv", ["x", "w"], ["y"]),
    ]
    arrays = {"d": np.float32(255), "w": WEIGHTS}
    assert first_gain(save(tmp_path / "a.onnx", scaled, arrays)) is None
    quantised = {"w": WEIGHTS.astype(np.int8), **INDICES}
    assert first_gain(save(tmp_path / "b.onnx", focus_and_conv(), quantised)) is None
    assert first_gain(save(tmp_path / "c.onnx", focus_and_conv("absent"), INDICES)) is None


def test_weights_kept_in_another_file_are_not_judged(tmp_path):
    path = save(tmp_path / "m.onnx", focus_and_conv(), {"w": WEIGHTS, **INDICES})
    model = onnx.load(path)
    onnx.save(model, path, save_as_external_data=True, location="m.data", size_threshold=0)
    assert first_gain(path) is None


def test_no_file_is_an_error(tmp_path):
    with pytest.raises(DetectorError, match="cannot read"):
        first_gain(tmp_path / "none.onnx")


@settings(
    deadline=None, max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(data=st.data())
def test_any_bytes_are_read_or_refused(tmp_path, data):
    path = tmp_path / "m.onnx"
    if not path.exists():
        save(path, focus_and_conv(), {"w": WEIGHTS[:1, :2], **INDICES})
        (tmp_path / "whole").write_bytes(path.read_bytes())
    whole = bytearray((tmp_path / "whole").read_bytes())
    for _ in range(data.draw(st.integers(0, 6))):
        whole[data.draw(st.integers(0, len(whole) - 1))] = data.draw(st.integers(0, 255))
    path.write_bytes(bytes(whole[: data.draw(st.integers(0, len(whole)))]))
    try:
        first = first_gain(path)
    except DetectorError:
        return
    assert first is None or np.isfinite(first)
