"""Makes an artefact from trained parameters and proves that its four forms of the policy agree.

Imports JAX, ONNX and ONNX Runtime; the robot needs none of them for the paper's network.
All forms take a batch-last history (8, 11, B), oldest observation first, and give actions (8, B).
"""

from __future__ import annotations

import io
import json
import os
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jax
import jax.export
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

from robot_io import contract
from robot_io.policy import artefact as artefacts
from robot_io.policy import jax_policy
from robot_io.policy.artefact import ArtefactError
from robot_io.policy.backends import make_policy
from robot_io.policy.jax_policy import Policy

AGREEMENT = 1e-5  # largest difference allowed between any two forms of the policy, of an action in [-1, 1]
GOLDEN_COUNT = 64
ONNX_OPSET = 17
ONNX_IR_VERSION = 8  # the IR that came with opset 17, so older runtimes load it too


def write(
    folder: str | Path,
    policy: Policy,
    provenance: dict[str, Any],
    overwrite: bool = False,
    robot: contract.Contract = contract.PAPER,
) -> dict[str, Any]:
    """Writes a policy as an artefact and returns ``verify``'s report.

    ``robot`` is whose policy it is; ``provenance`` is plain JSON data kept in the manifest: training configuration, git
    state, seed, return rate.
    The artefact is built and verified in a hidden folder beside ``folder`` and renamed into place, so ``folder`` never
    holds half of one. An existing artefact is replaced only with ``overwrite``; a folder that holds anything else never
    is. Numbers are stored as float32.

    Raises ArtefactError for arrays of a wrong shape, non-finite numbers, provenance that is not JSON, or an existing
    folder; OSError when the disk refuses.
    """
    folder = Path(folder).resolve()
    _check_target(folder, overwrite)
    given, size = policy.network, robot.n_observation
    network = None if given is None else jax_policy.exported(given, size)
    parameters = contract.n_parameters(robot.n_joints) if network is None else network.size
    policy = Policy(
        _finite(policy.theta, "theta", (parameters,)),
        _finite(policy.mean, "mean", (size,)),
        _finite(policy.inv_std, "inv_std", (size,)),
        network,
    )
    contents = _contents(policy, provenance, given, robot)

    folder.parent.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as hidden:
        made, replaced = Path(hidden) / "made", Path(hidden) / "replaced"
        made.mkdir()
        for name, content in contents.items():
            with open(made / name, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        report = verify(made)
        _check_target(folder, overwrite)  # again: the target may have appeared meanwhile
        if folder.exists():  # a folder cannot be renamed over a full one
            os.rename(folder, replaced)
        try:
            os.rename(made, folder)
        except OSError:
            if replaced.exists():
                os.rename(replaced, folder)
            raise
    return report


def verify(folder: str | Path, seed: int = 0) -> dict[str, Any]:
    """Loads an artefact and compares its four forms on 1,000 random observation histories.

    Returns {"digest", "largest_difference" (between any two forms), "from_reference" (per form against the NumPy
    reference)}. Raises ArtefactError when the artefact does not load or its forms disagree.
    """
    artefact = artefacts.load(folder)
    policy = artefact.policy
    history = random_histories(policy, 1000, seed)
    if policy.network is None:
        model, exported = ((artefact.folder / name).read_bytes() for name in (artefacts.ONNX, artefacts.JAX_EXPORT))
        session = onnxruntime.InferenceSession(model, providers=["CPUExecutionProvider"])
        reference, allowed = policy.apply(history), AGREEMENT
        with jax.default_device(jax.devices("cpu")[0]):
            actions = {
                "jit": np.asarray(jax_policy.jitted_forward(policy.astype(np.float32), history)),
                "onnxruntime": session.run(["action"], {"history": history})[0],
                "jax_export": np.asarray(jax.export.deserialize(bytearray(exported)).call(history)),
            }
    else:
        # Its other form, the user's Python, is not run here: golden.npz is what that wrote. The exported step must
        # remember nothing of an episode before.
        runner, episode = make_policy("jit", policy, artefact.contract), history[0].T
        reference, allowed = runner.episode(episode), 0.0
        actions = {"jax_export": runner.episode(episode)}
    from_reference = {name: float(np.max(np.abs(action - reference))) for name, action in actions.items()}
    largest = float(np.max(np.ptp([reference, *actions.values()], axis=0)))
    if not largest <= allowed:
        raise ArtefactError(
            f"{folder}: its forms of the policy, or its answers to the same episode played twice, differ by "
            f"{largest:.3g} (from the reference: {from_reference}), allowed is {allowed:g}; do not run it, export the "
            "policy again"
        )
    return {"digest": artefact.digest, "largest_difference": largest, "from_reference": from_reference}


def random_histories(policy: Policy, count: int, seed: int) -> np.ndarray:
    """Observation histories (8, 11, count), float32, spread twice as wide as what the normaliser saw in training."""
    mean, inv_std = policy.mean, policy.inv_std
    scale = np.divide(1.0, inv_std, out=np.ones_like(inv_std), where=inv_std > 0)
    standard = np.random.default_rng(seed).standard_normal((contract.HISTORY, policy.n_observation, count))
    return (mean[:, None] + 2.0 * scale[:, None] * standard).astype(np.float32)


def onnx_model(policy: Policy, robot: contract.Contract = contract.PAPER) -> onnx.ModelProto:
    """The policy with its normaliser as a graph of standard operators: "history" (8, 11, B) to "action" (8, B).

    Its metadata say what the numbers are: names, units, the scale of each action and the rate; whole as JSON
    under ``contract``.
    """
    parameters, nodes = policy.parameters, []
    constants = {"mean": policy.mean[:, None], "inverse_scale": policy.inv_std[:, None]}

    def add(kind: str, inputs: str, outputs: str, **attributes: Any) -> None:
        nodes.append(helper.make_node(kind, inputs.split(), outputs.split(), **attributes))

    add("Sub", "history mean", "centred")
    add("Mul", "centred inverse_scale", "normalised")
    add("Transpose", "normalised", "layer0", perm=[2, 1, 0])  # Conv wants (B, channels, time)
    for i, (dilation, gated) in enumerate(zip(contract.DILATIONS, contract.GATED, strict=True), start=1):
        constants[f"kernel{i}"] = np.ascontiguousarray(parameters[f"conv{i}/kernel"].transpose(2, 1, 0))
        constants[f"bias{i}"] = parameters[f"conv{i}/bias"]
        inputs, taps = f"layer{i - 1} kernel{i} bias{i}", [contract.KERNEL]
        add("Conv", inputs, f"conv{i}", kernel_shape=taps, dilations=[dilation])
        if gated:
            add("Split", f"conv{i}", f"signal{i} gate{i}", axis=1)
            add("Tanh", f"signal{i}", f"tanh{i}")
            add("Sigmoid", f"gate{i}", f"sigmoid{i}")
            add("Mul", f"tanh{i} sigmoid{i}", f"layer{i}")
        else:
            add("Tanh", f"conv{i}", f"layer{i}")
    constants["time_axis"] = np.array([2], np.int64)
    add("Squeeze", f"layer{len(contract.FILTERS)} time_axis", "batch_first")
    add("Transpose", "batch_first", "action", perm=[1, 0])
    value = helper.make_tensor_value_info
    graph = helper.make_graph(
        nodes,
        "table_tennis_policy",
        [value("history", TensorProto.FLOAT, [contract.HISTORY, policy.n_observation, "batch"])],
        [value("action", TensorProto.FLOAT, [policy.n_observation - 3, "batch"])],
        [numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", ONNX_OPSET)], ir_version=ONNX_IR_VERSION)
    whole = contract.describe(robot)
    columns = {
        f"{kind}_{key}": [str(row[key]) for row in whole[kind]]
        for kind in ("observation", "action")
        for key in ("name", "unit")
    }
    columns["action_scale"] = [repr(row["scale"]) for row in whole["action"]]
    properties = {key: ",".join(values) for key, values in columns.items()}
    properties |= {"control_rate_hz": repr(whole["control_rate_hz"]), "contract": json.dumps(whole)}
    helper.set_model_props(model, properties)
    onnx.checker.check_model(model, full_check=True)
    return model


def jax_export(policy: Policy) -> bytes:
    """The policy with its numbers inside, serialised by ``jax.export``, any batch size."""
    shape = jax.export.symbolic_shape(f"{contract.HISTORY}, {policy.n_observation}, batch")
    return jax_policy.serialised(partial(jax_policy.exact_forward, policy), jax.ShapeDtypeStruct(shape, jnp.float32))


def _contents(policy: Policy, provenance: dict[str, Any], given: Any, robot: contract.Contract) -> dict[str, bytes]:
    """Files of the artefact by name. given: the user-defined network as it was before its export, or None."""
    history = random_histories(policy, GOLDEN_COUNT, seed=1)
    network = policy.network
    if network is None:
        golden = {"history": history, "action": policy.apply(history)}
        forms = {
            artefacts.ONNX: onnx_model(policy, robot).SerializeToString(),
            artefacts.JAX_EXPORT: jax_export(policy),
        }
        architecture = artefacts.architecture(robot)
    else:
        episode = np.ascontiguousarray(history[0].T)
        if given is network:  # all that is left of a network after fine-tuning
            action = artefacts.answer(policy, episode, robot)
        else:
            action = jax_policy.reference(given, policy, episode)
        golden = {"observation": episode, "action": action.astype(np.float64)}
        forms = {artefacts.NETWORK: network.source.encode(), artefacts.JAX_EXPORT: network.exported}
        architecture = {
            "network": network.name,
            "parameters": {name: list(shape) for name, shape in network.shapes},
            "n_parameters": network.size,
            "step": f"{artefacts.JAX_EXPORT}: theta, mean, inverse_scale, first, state, observation -> action, state",
        }
    contents = {artefacts.PARAMETERS: _npz(policy.parameters), artefacts.GOLDEN: _npz(golden), **forms}
    manifest = {
        "schema_version": artefacts.SCHEMA_VERSION,
        "contract": contract.describe(robot),
        "architecture": architecture,
        "normaliser": {
            "formula": artefacts.NORMALISER_FORMULA,
            "mean": [float(v) for v in policy.mean],
            "inverse_scale": [float(v) for v in policy.inv_std],
        },
        "golden": {"file": artefacts.GOLDEN, "count": GOLDEN_COUNT, "tolerance": artefacts.tolerance(policy.network)},
        "files": {name: artefacts.sha256(content) for name, content in contents.items()},
        "provenance": provenance,
        "written_with": {
            "utc": datetime.now(UTC).isoformat(timespec="seconds"),
            "jax": jax.__version__,
            "numpy": np.__version__,
            "onnx": onnx.__version__,
            "onnx_opset": ONNX_OPSET,
        },
    }
    try:
        raw = json.dumps(manifest, indent=2, allow_nan=False).encode()
    except (TypeError, ValueError) as error:
        message = f"{artefacts.MANIFEST}: provenance is not plain JSON ({error}); convert it first"
        raise ArtefactError(message) from error
    return contents | {artefacts.MANIFEST: raw, artefacts.MANIFEST_DIGEST: artefacts.digest_line(raw)}


def _npz(arrays: dict[str, np.ndarray]) -> bytes:
    buffer = io.BytesIO()
    savez: Callable[..., None] = np.savez  # its stub takes arrays by name for its own arguments
    savez(buffer, **arrays)
    return buffer.getvalue()


def _finite(array: np.ndarray, name: str, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(array, np.float32)
    if array.shape != shape:
        raise ArtefactError(f"{name} has shape {array.shape}, expected {shape}")
    bad = np.flatnonzero(~np.isfinite(array))
    if bad.size:
        raise ArtefactError(
            f"{name}[{bad[0]}] is {array[bad[0]]} ({bad.size} non-finite in all); export an earlier checkpoint"
        )
    return array


def _check_target(folder: Path, overwrite: bool) -> None:
    if not folder.exists():
        return
    if not overwrite:
        raise ArtefactError(f"{folder}: already exists; choose another name or overwrite it explicitly")
    if not folder.is_dir():
        raise ArtefactError(f"{folder}: is a file, an artefact is a folder; choose another name")
    foreign = sorted({entry.name for entry in folder.iterdir()} - {*artefacts.FILES, *artefacts.USER_DEFINED_FILES})
    if foreign:
        raise ArtefactError(
            f"{folder}: holds {', '.join(foreign)}, which no artefact does; not overwritten, choose another name"
        )
