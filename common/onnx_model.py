"""ONNX Runtime session with checks of the network's inputs and outputs before the first run.

On a CPU, one thread is used, without active waiting (spinning). On two busy cores a second thread is not
faster, and spinning threads doubled the latency of the small network.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort

from beamsplat.common.errors import UserError

# In order of preference; the installed onnxruntime package decides which are available.
PROVIDERS = (
    "TensorrtExecutionProvider", "CUDAExecutionProvider", "OpenVINOExecutionProvider",
    "CoreMLExecutionProvider", "CPUExecutionProvider",
)  # fmt: skip
_DTYPES = {
    "tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64,
    "tensor(int64)": np.int64,  # of inputs that are numbers, not images
}  # fmt: skip


@dataclass(frozen=True)
class TensorSpec:
    """Name, shape and dtype of one input or output of a network; None in the shape = dynamic size."""

    name: str
    shape: tuple[int | None, ...]
    dtype: np.dtype


def available_providers(wanted: tuple[str, ...] = PROVIDERS) -> list[str]:
    """Return those of the execution providers `wanted` that this onnxruntime has, in the same order."""
    available = set(ort.get_available_providers())
    return [name for name in wanted if name in available]


class OnnxModel:
    """An ONNX Runtime session with checked inputs and outputs.

    Raises:
        UserError: the file is missing, is no ONNX graph, or has tensors of an unsupported type.
    """

    def __init__(self, path: Path, *, threads: int = 1, providers: tuple[str, ...] = PROVIDERS) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise UserError(
                f"{self.path}: no such model file; `beamsplat models list` shows what can be downloaded, "
                "or set BEAMSPLAT_MODELS to the folder that holds it"
            )
        options = ort.SessionOptions()
        options.intra_op_num_threads = threads
        options.inter_op_num_threads = 1
        options.execution_mode = ort.ExecutionMode.ORT_SEQUENTIAL
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        options.log_severity_level = 3
        chosen = available_providers(providers)
        if not chosen:
            raise UserError(
                f"{self.path}: none of the execution providers {', '.join(providers)} is available; "
                f"this onnxruntime has {', '.join(ort.get_available_providers())}"
            )
        try:
            self._session = ort.InferenceSession(str(self.path), options, providers=chosen)
        except Exception as error:  # onnxruntime's own exception types share no base but this
            reason = str(error).strip().split("\n")[0][:200]
            raise UserError(f"{self.path}: not an ONNX graph that can run here: {reason}") from error
        self.providers = self._session.get_providers()
        self.metadata: dict[str, str] = dict(self._session.get_modelmeta().custom_metadata_map)
        self.inputs = [self._tensor_spec(node) for node in self._session.get_inputs()]
        self.outputs = [self._tensor_spec(node) for node in self._session.get_outputs()]

    def _tensor_spec(self, node: ort.NodeArg) -> TensorSpec:
        if node.type not in _DTYPES:
            raise UserError(f"{self.path}: {node.name} is {node.type}; expected a tensor of floats or int64")
        shape = tuple(size if isinstance(size, int) and size > 0 else None for size in node.shape)
        return TensorSpec(node.name, shape, np.dtype(_DTYPES[node.type]))

    def image_input(self, number: int = 0, name: str | None = None) -> TensorSpec:
        """Return the input for an RGB image, N x 3 x H x W: the input called `name`, else input `number`.

        Raises:
            UserError: no such input, or its shape is not N x 3 x H x W.
        """
        spec = next((p for p in self.inputs if p.name == name), None)
        if spec is None:
            if number >= len(self.inputs):
                raise UserError(f"{self.path}: has {len(self.inputs)} inputs; expected one for the image")
            spec = self.inputs[number]
        if len(spec.shape) != 4 or spec.shape[1] not in (3, None):
            channels_last = len(spec.shape) == 4 and spec.shape[3] == 3
            hint = " (channels last: export it with N x 3 x H x W)" if channels_last else ""
            raise UserError(
                f"{self.path}: input {spec.name!r} has shape {_show(spec.shape)}; not N x 3 x H x W{hint}"
            )
        return spec

    def output(self, name: str) -> TensorSpec:
        """Return the spec of the output called `name`.

        Raises:
            UserError: no such output; the message lists all outputs.
        """
        for spec in self.outputs:
            if spec.name == name:
                return spec
        available = ", ".join(spec.name for spec in self.outputs)
        raise UserError(
            f"{self.path}: has no output {name!r}; it has {available}: the file holds another network"
        )

    def check_inputs(self, count: int) -> None:
        """Raise UserError unless the network has exactly `count` inputs."""
        if len(self.inputs) != count:
            names = ", ".join(spec.name for spec in self.inputs)
            raise UserError(f"{self.path}: takes {len(self.inputs)} inputs ({names}); expected {count}")

    def input_size(self, spec: TensorSpec, height: int, width: int, multiple: int) -> tuple[int, int]:
        """Return (height, width) of the network input: fixed sizes of the graph, else `height` and `width`.

        Raises:
            UserError: a side is not a multiple of `multiple`.
        """
        chosen = (spec.shape[2] or height, spec.shape[3] or width)
        for side in chosen:
            if side % multiple:
                raise UserError(
                    f"{self.path}: a side of {side} px is not a multiple of {multiple}, as the network needs"
                )
        return chosen

    def run(self, *arrays: np.ndarray, outputs: tuple[str, ...] | None = None) -> list[np.ndarray]:
        """Run the network and return its outputs as float32 arrays.

        Args:
            arrays: the inputs, in the order of the graph.
            outputs: names of the outputs to return; None = all.

        Raises:
            UserError: the network rejects the shape of an input.
        """
        feed = {
            spec.name: np.asarray(array, dtype=spec.dtype, order="C")
            for spec, array in zip(self.inputs, arrays, strict=True)
        }
        try:
            results = self._session.run(list(outputs) if outputs else None, feed)
        except Exception as error:  # onnxruntime's own exception types share no base but this
            shapes = ", ".join(f"{name} {list(a.shape)}" for name, a in feed.items())
            reason = str(error).strip().split("\n")[0][:200]
            raise UserError(f"{self.path}: the graph rejected {shapes}: {reason}") from error
        return [np.asarray(result, dtype=np.float32) for result in results]

    def warm_up(self, *shapes: tuple[int, ...]) -> list[np.ndarray]:
        """Run the network twice on grey inputs of `shapes`, to allocate all buffers; return the outputs."""
        arrays = [np.full(shape, 0.5, dtype=np.float32) for shape in shapes]
        self.run(*arrays)
        return self.run(*arrays)


def to_hw(output: np.ndarray, where: str) -> np.ndarray:
    """Return a network output of shape [1, 1, H, W], [1, H, W] or [H, W] as [H, W].

    Raises:
        UserError: any other shape.
    """
    squeezed = output
    while squeezed.ndim > 2 and squeezed.shape[0] == 1:
        squeezed = squeezed[0]
    if squeezed.ndim != 2:
        raise UserError(f"{where}: output has shape {list(output.shape)}; expected one map of H x W")
    return squeezed


def _show(shape: tuple[int | None, ...]) -> str:
    return " x ".join("?" if size is None else str(size) for size in shape)
