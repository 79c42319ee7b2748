"""One checked ONNX session: what the graph says is compared with what an adapter needs, before the first run.

On a CPU: one thread and no spinning. Two cores that are busy gain nothing from a second thread, and
spinning threads doubled the latency of the small network.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import onnxruntime as ort

from beamsplat.common.errors import UserError

# In order of preference; what onnxruntime was built with decides.
PROVIDERS = (
    "TensorrtExecutionProvider", "CUDAExecutionProvider", "OpenVINOExecutionProvider",
    "CoreMLExecutionProvider", "CPUExecutionProvider",
)  # fmt: skip
_DTYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16, "tensor(double)": np.float64}


@dataclass(frozen=True)
class TensorSpec:
    """One input or output of a graph; None stands for a size that is free."""

    name: str
    shape: tuple[int | None, ...]
    dtype: np.dtype


def available_providers(wanted: tuple[str, ...] = PROVIDERS) -> list[str]:
    """Those of `wanted` that this onnxruntime has, in that order."""
    there = set(ort.get_available_providers())
    return [name for name in wanted if name in there]


class OnnxModel:
    """A session with known ports.

    Raises:
        UserError: no such file, not an ONNX graph, or ports of an unknown kind; names the file.
    """

    def __init__(self, path: Path, *, threads: int = 1, providers: tuple[str, ...] = PROVIDERS) -> None:
        self.path = Path(path)
        if not self.path.is_file():
            raise UserError(
                f"{self.path}: no such model file; `beamsplat models list` shows what can be fetched, "
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
                f"{self.path}: none of the execution providers {', '.join(providers)} is there; "
                f"this onnxruntime has {', '.join(ort.get_available_providers())}"
            )
        try:
            self._session = ort.InferenceSession(str(self.path), options, providers=chosen)
        except Exception as error:  # onnxruntime's own exception types share no base but this
            reason = str(error).strip().split("\n")[0][:200]
            raise UserError(f"{self.path}: not an ONNX graph that can run here: {reason}") from error
        self.providers = self._session.get_providers()
        self.inputs = [self._port(node) for node in self._session.get_inputs()]
        self.outputs = [self._port(node) for node in self._session.get_outputs()]

    def _port(self, node: ort.NodeArg) -> TensorSpec:
        if node.type not in _DTYPES:
            raise UserError(f"{self.path}: {node.name} is {node.type}; expected a float tensor")
        shape = tuple(size if isinstance(size, int) and size > 0 else None for size in node.shape)
        return TensorSpec(node.name, shape, np.dtype(_DTYPES[node.type]))

    def image_input(self, number: int = 0, name: str | None = None) -> TensorSpec:
        """The input of an RGB image, N x 3 x H x W, by name if there is one of that name, else by number.

        Raises:
            UserError: there is no such input, or it does not take three channels first.
        """
        port = next((p for p in self.inputs if p.name == name), None)
        if port is None:
            if number >= len(self.inputs):
                raise UserError(f"{self.path}: has {len(self.inputs)} inputs; expected one for the image")
            port = self.inputs[number]
        if len(port.shape) != 4 or port.shape[1] not in (3, None):
            channels_last = len(port.shape) == 4 and port.shape[3] == 3
            hint = " (channels last: export it with N x 3 x H x W)" if channels_last else ""
            raise UserError(
                f"{self.path}: input {port.name!r} has shape {_show(port.shape)}; not N x 3 x H x W{hint}"
            )
        return port

    def output(self, name: str) -> TensorSpec:
        """The output of that name.

        Raises:
            UserError: there is none; names those there are.
        """
        for port in self.outputs:
            if port.name == name:
                return port
        there = ", ".join(port.name for port in self.outputs)
        raise UserError(f"{self.path}: has no output {name!r}; it has {there}: not the graph expected here")

    def check_inputs(self, count: int) -> None:
        """Raises UserError unless the graph takes `count` inputs."""
        if len(self.inputs) != count:
            names = ", ".join(port.name for port in self.inputs)
            raise UserError(f"{self.path}: takes {len(self.inputs)} inputs ({names}); expected {count}")

    def input_size(self, port: TensorSpec, height: int, width: int, multiple: int) -> tuple[int, int]:
        """(height, width) to feed: the graph's own where it fixes them, else the wished ones.

        Raises:
            UserError: a side is no multiple of what the network can take.
        """
        chosen = (port.shape[2] or height, port.shape[3] or width)
        for side in chosen:
            if side % multiple:
                raise UserError(
                    f"{self.path}: a side of {side} px is no multiple of {multiple}, which this network needs"
                )
        return chosen

    def run(self, *arrays: np.ndarray, outputs: tuple[str, ...] | None = None) -> list[np.ndarray]:
        """Output arrays as float32; inputs in the order of the graph.

        Raises:
            UserError: the graph refuses the input (shape inside the graph does not fit).
        """
        feed = {
            port.name: np.ascontiguousarray(array, dtype=port.dtype)
            for port, array in zip(self.inputs, arrays, strict=True)
        }
        try:
            results = self._session.run(list(outputs) if outputs else None, feed)
        except Exception as error:  # onnxruntime's own exception types share no base but this
            shapes = ", ".join(f"{name} {list(a.shape)}" for name, a in feed.items())
            reason = str(error).strip().split("\n")[0][:200]
            raise UserError(f"{self.path}: the graph refused {shapes}: {reason}") from error
        return [np.asarray(result, dtype=np.float32) for result in results]

    def warm_up(self, *shapes: tuple[int, ...]) -> list[np.ndarray]:
        """Two runs on grey, so that the first image does not pay for allocation; gives the outputs."""
        arrays = [np.full(shape, 0.5, dtype=np.float32) for shape in shapes]
        self.run(*arrays)
        return self.run(*arrays)


def to_hw(output: np.ndarray, where: str) -> np.ndarray:
    """[1, 1, H, W], [1, H, W] or [H, W] as [H, W].

    Raises:
        UserError: anything else.
    """
    squeezed = output
    while squeezed.ndim > 2 and squeezed.shape[0] == 1:
        squeezed = squeezed[0]
    if squeezed.ndim != 2:
        raise UserError(f"{where}: output has shape {list(output.shape)}; expected one map of H x W")
    return squeezed


def _show(shape: tuple[int | None, ...]) -> str:
    return " x ".join("?" if size is None else str(size) for size in shape)
