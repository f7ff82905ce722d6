"""The trained network and the search's classifier as ONNX, with golden crops that every runtime must reproduce."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
    """Nodes of a graph in order, each named by its output; constants, and weights as LAYER/kernel and LAYER/bias."""

    def __init__(self, weights: Weights, **constants: Any) -> None:
        self.nodes: list[Any] = []
        named = {
            f"{layer}/{leaf}": np.asarray(value) for layer, part in weights.items() for leaf, value in part.items()
        }
        # A convolution's kernel (h, w, in, out) is (out, in, h, w) here.
        named = {name: value.transpose(3, 2, 0, 1) if value.ndim == 4 else value for name, value in named.items()}
        self.constants = named | {name: np.asarray(value) for name, value in constants.items()}

    def add(self, kind: str, *inputs: str, output: str = "", **attributes: Any) -> str:
        output = output or f"{kind}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, inputs, [output], **attributes))
        return output

    def convolve(self, x: str, layer: str, dilation: int = 1, stride: int = 1, output: str = "") -> str:
        """A convolution that pads as XLA's SAME does for even sides."""
        span = dilation * (self.constants[f"{layer}/kernel"].shape[-1] - 1)
        low = (span - stride + 1) // 2
        high = span - (stride - 1) - low
        shape = {"dilations": [dilation] * 2, "strides": [stride] * 2, "pads": [low, low, high, high]}
        return self.add("Conv", x, f"{layer}/kernel", f"{layer}/bias", output=output, **shape)

    def save(self, path: Path, kind: int, inputs: Mapping[str, Sequence], outputs: Mapping[str, Sequence]) -> None:
        """Writes it; shapes of inputs, which are of a kind, and of outputs, which are floats."""
        given, said = (
            [helper.make_tensor_value_info(name, number, ["n", *shape]) for name, shape in ends.items()]
            for ends, number in ((inputs, kind), (outputs, TensorProto.FLOAT))
        )
        constants = [numpy_helper.from_array(value, name) for name, value in self.constants.items()]
        graph = helper.make_graph(self.nodes, path.stem, given, said, constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        onnx.save(model, path)


def export_network(path: Path, params: Weights) -> None:
    """Writes the network: inputs fine, coarse (n, 3, 64, 64) uint8, newest frame first; what ``network`` says of
    fine and of coarse cells (n, c, 16, 16)."""
    side = SIZE // 4
    middle = {"starts": [side // 4] * 2, "ends": [3 * side // 4] * 2, "axes": [2, 3]}
    g = _Graph(
        params,
        full=np.float32(255),
        dark=np.float32(network.DARK),
        scales=np.array([1, 1, 2, 2], np.float32),
        **{name: np.array(value, np.int64) for name, value in middle.items()},
    )

    def prepare(name: str) -> str:
        quads = g.add("SpaceToDepth", g.add("Cast", name, to=TensorProto.FLOAT), blocksize=2)
        return g.add("Sqrt", g.add("Add", g.add("Div", quads, "full"), "dark"))

    def convolve(x: str, layer: str, dilation: int = 1, stride: int = 1) -> str:
        return g.add("Relu", g.convolve(x, layer, dilation, stride))

    far = convolve(prepare("coarse"), "coarse", stride=2)
    for k, dilation in enumerate(network.COARSE_BLOCKS):
        far = g.add("Add", far, convolve(far, f"coarse{k}", dilation))
    g.convolve(convolve(far, "past"), "past_out", output="past_cells")
    far = g.convolve(g.add("Slice", far, *middle), "join")
    nearest = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
    far = g.add("Resize", far, "", "scales", **nearest)
    x = convolve(prepare("fine"), "fine", stride=2)
    for k, dilation in enumerate(network.BLOCKS):
        if k == 1:
            x = g.add("Add", x, far)
        x = g.add("Add", x, g.convolve(convolve(x, f"block{k}", dilation), f"mix{k}"))
    g.convolve(convolve(x, "last"), "out", output="cells")
    window = (FRAMES, SIZE, SIZE)
    outputs = {"cells": (OUTPUTS, side, side), "past_cells": (FAR_OUTPUTS, side, side)}
    g.save(path, TensorProto.UINT8, {"fine": window, "coarse": window}, outputs)


def export_search(path: Path, layers: Weights) -> None:
    """Writes the classifier of places: features (n, 490) to scores (n,), the logarithm of the odds of a ball."""
    g = _Graph(layers, last=np.array([1], np.int64))
    x = g.add("Relu", g.add("Gemm", "places", "first/kernel", "first/bias"))
    g.add("Squeeze", g.add("Gemm", x, "second/kernel", "second/bias"), "last", output="score")
    g.save(path, TensorProto.FLOAT, {"places": (2 * (FRAMES * (2 * PLACE + 1) ** 2 + 2),)}, {"score": ()})


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
