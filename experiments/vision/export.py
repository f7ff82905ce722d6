"""The trained network and the search's classifier as ONNX, with golden crops that every runtime must reproduce."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from experiments.vision import network
from experiments.vision.crops import Crops
from robot_io.vision.detector import FAR_OUTPUTS, FRAMES, NETWORK, OUTPUTS, PLACE, SEARCH, SIZE

GOLDEN = "golden.npz"
GOLDEN_COUNT = 8
AGREEMENT = 2e-3  # largest difference of a number of the network between JAX and ONNX
OPSET, IR_VERSION = 17, 8

Weights = Mapping[str, Mapping[str, Any]]


class _Graph:
    """Nodes and constants of a graph, in order."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, name: str, value: Any) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value), name))
        return name

    def add(self, kind: str, inputs: list[str], name: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(kind, inputs, [name], **attributes))
        return name

    def convolve(self, x: str, name: str, layer: Mapping[str, Any], dilation: int = 1, stride: int = 1) -> str:
        """A convolution that pads as XLA's SAME does for even sides."""
        kernel = np.asarray(layer["kernel"])
        span = dilation * (kernel.shape[0] - 1)
        low = (span - stride + 1) // 2 if stride > 1 else span // 2
        high = span - (stride - 1) - low
        inputs = [
            x,
            self.constant(f"{name}/kernel", kernel.transpose(3, 2, 0, 1)),
            self.constant(f"{name}/bias", np.asarray(layer["bias"])),
        ]
        return self.add(
            "Conv", inputs, name, dilations=[dilation] * 2, strides=[stride] * 2, pads=[low, low, high, high]
        )  # fmt: skip

    def save(self, path: Path, inputs: list[Any], outputs: list[Any]) -> None:
        graph = helper.make_graph(self.nodes, path.stem, inputs, outputs, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        onnx.save(model, path)


def export_network(path: Path, params: Weights) -> None:
    """Writes the network: inputs fine, coarse (n, 3, 64, 64) uint8, newest frame first; what ``network`` says of
    fine and of coarse cells (n, c, 16, 16)."""
    g = _Graph()
    full, dark = g.constant("full", np.float32(255)), g.constant("dark", np.float32(network.DARK))

    def prepare(name: str) -> str:
        x = g.add("Cast", [name], f"{name}/float", to=TensorProto.FLOAT)
        x = g.add("SpaceToDepth", [x], f"{name}/quads", blocksize=2)
        x = g.add("Add", [g.add("Div", [x, full], f"{name}/scaled"), dark], f"{name}/lifted")
        return g.add("Sqrt", [x], f"{name}/root")

    def relu(x: str) -> str:
        return g.add("Relu", [x], f"{x}/relu")

    far = relu(g.convolve(prepare("coarse"), "coarse0/first", params["coarse"], stride=2))
    for k, dilation in enumerate(network.COARSE_BLOCKS):
        far = g.add("Add", [far, relu(g.convolve(far, f"far{k}", params[f"coarse{k}"], dilation))], f"far{k}/sum")
    past = relu(g.convolve(far, "past", params["past"]))
    past = g.convolve(past, "past_cells", params["past_out"])
    quarter = SIZE // 16
    ends = [
        g.constant(n, np.array(v, np.int64))
        for n, v in (("starts", [quarter] * 2), ("ends", [3 * quarter] * 2), ("axes", [2, 3]))
    ]
    far = g.add("Slice", [far, *ends], "far/middle")
    far = g.convolve(far, "far/join", params["join"])
    scales = g.constant("scales", np.array([1, 1, 2, 2], np.float32))
    far = g.add(
        "Resize",
        [far, "", scales],
        "far/wide",
        mode="nearest",
        coordinate_transformation_mode="asymmetric",
        nearest_mode="floor",
    )
    x = relu(g.convolve(prepare("fine"), "fine0/first", params["fine"], stride=2))
    for k, dilation in enumerate(network.BLOCKS):
        if k == 1:
            x = g.add("Add", [x, far], "joined")
        y = relu(g.convolve(x, f"block{k}", params[f"block{k}"], dilation))
        x = g.add("Add", [x, g.convolve(y, f"mix{k}", params[f"mix{k}"])], f"sum{k}")
    x = relu(g.convolve(x, "last", params["last"]))
    out = g.convolve(x, "cells", params["out"])
    inputs = [
        helper.make_tensor_value_info(n, TensorProto.UINT8, ["n", FRAMES, SIZE, SIZE]) for n in ("fine", "coarse")
    ]
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", numbers, SIZE // 4, SIZE // 4])
        for name, numbers in ((out, OUTPUTS), (past, FAR_OUTPUTS))
    ]
    g.save(path, inputs, outputs)


def export_search(path: Path, layers: Weights) -> None:
    """Writes the classifier of places: features (n, 490) to scores (n,), the logarithm of the odds of a ball."""
    g, x = _Graph(), "places"
    for name in ("first", "second"):
        x = g.add(
            "Gemm",
            [
                x,
                g.constant(f"{name}/kernel", np.asarray(layers[name]["kernel"])),
                g.constant(f"{name}/bias", np.asarray(layers[name]["bias"])),
            ],
            name,
        )
        x = g.add("Relu", [x], f"{name}/relu") if name == "first" else x
    out = g.add("Squeeze", [x, g.constant("last", np.array([1], np.int64))], "score")
    size = 2 * (FRAMES * (2 * PLACE + 1) ** 2 + 2)
    g.save(
        path,
        [helper.make_tensor_value_info("places", TensorProto.FLOAT, ["n", size])],
        [helper.make_tensor_value_info(out, TensorProto.FLOAT, ["n"])],
    )


def export(folder: Path, params: Weights, search: Weights, crops: Crops) -> float:
    """Writes both and the golden crops; returns the largest difference between JAX and ONNX.

    Raises ValueError where that is above AGREEMENT.
    """
    folder.mkdir(parents=True, exist_ok=True)
    export_network(folder / NETWORK, params)
    export_search(folder / SEARCH, search)
    fine, coarse = crops.fine[:GOLDEN_COUNT], crops.coarse[:GOLDEN_COUNT]
    cells, past = (np.asarray(said).transpose(0, 3, 1, 2) for said in network.apply(params, fine, coarse))
    np.savez_compressed(
        folder / GOLDEN, fine=fine, coarse=coarse, cells=cells, past=past, labels=crops.labels[:GOLDEN_COUNT]
    )
    worst = check_golden(folder)
    if worst > AGREEMENT:
        raise ValueError(f"expected ONNX to agree with JAX to {AGREEMENT:g}, got {worst:.2g}; the export is wrong")
    return worst


def check_golden(folder: Path) -> float:
    """Largest difference between the golden crops' outputs and what ONNX Runtime says of them here."""
    session = onnxruntime.InferenceSession(str(folder / NETWORK), providers=["CPUExecutionProvider"])
    golden = np.load(folder / GOLDEN)
    given = {name: np.ascontiguousarray(golden[name].transpose(0, 3, 1, 2)) for name in ("fine", "coarse")}
    said = session.run(None, given)
    return max(float(np.abs(a - golden[name]).max()) for a, name in zip(said, ("cells", "past"), strict=True))
