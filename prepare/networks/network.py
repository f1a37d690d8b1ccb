"""A network in an ONNX file, run by onnxruntime on the best available device.

onnxruntime is imported when a network is opened: training does not require it.
"""

import contextlib
import hashlib
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from panolog.prepare.networks.manifest import Input
from panolog.prepare.networks.seam import Floats
from panolog.scene.errors import ConfigError, DeviceError, RunError, in_one_line
from panolog.scene.files import sha256

DEVICES = {
    "cpu": "CPUExecutionProvider",
    "cuda": "CUDAExecutionProvider",
    "tensorrt": "TensorrtExecutionProvider",
}
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_FATAL = 4  # onnxruntime's log level: its errors are raised as ours, so its own lines would repeat them
_LONGEST = 200  # characters of an error of onnxruntime


class Network:
    """An opened network. Raises InputError if its file, its manifest and the device do not fit together."""

    def __init__(self, model: Path, given: Input, outputs: Sequence[str], device: str) -> None:
        """Opens it.

        Args: model, the ONNX file; given, its input by the manifest; outputs, the names of those that `run`
        returns; device, "auto" or one of DEVICES.
        """
        runtime = _runtime()
        self.model = model
        self._given, self._outputs = given, list(outputs)
        self._errors: tuple[type[Exception], ...] = _errors(runtime)
        self._session = self._open(runtime, device)
        self.device = next(name for name, it in DEVICES.items() if it == self._session.get_providers()[0])
        self._input, self._dtype, self.batch = self._check_input()
        self._check_outputs()

    def run(self, images: NDArray[np.uint8]) -> dict[str, Floats]:
        """The network's outputs for a batch.

        Args: images (N, height, width, 3) uint8 RGB of the input's size, N = `batch` where that is not 0.
        Returns each output as float32, its first axis N. Raises RunError if the network fails on them.
        """
        try:
            found = self._session.run(self._outputs, {self._input: self._tensor(images)})
        except self._errors as error:
            raise RunError(
                f"{self.model}: the network failed ({in_one_line(error, _LONGEST)}); try a smaller batch"
            ) from error
        return {
            name: self._array(name, value, len(images))
            for name, value in zip(self._outputs, found, strict=True)
        }

    @property
    def ends(self) -> tuple[list[str], list[str]]:
        """The inputs and the outputs of its file, each as its name, type and shape."""
        return _ends(self._session)

    def _tensor(self, images: NDArray[np.uint8]) -> NDArray[Any]:
        ordered = images if self._given.channels == "RGB" else images[..., ::-1]
        mean, std = (np.array(it, np.float32) for it in (self._given.mean, self._given.std))
        values: NDArray[Any] = (ordered.astype(np.float32) / np.float32(self._given.divisor) - mean) / std
        if self._given.layout == "NCHW":
            values = values.transpose(0, 3, 1, 2)
        return np.ascontiguousarray(values, self._dtype)

    def _array(self, name: str, value: Any, count: int) -> Floats:
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiub":
            raise ConfigError(f"{self.model}: its output {name} is not an array of numbers")
        if value.ndim == 2 and count == 1:
            value = value[None]
        if value.ndim < 3 or value.shape[0] != count:
            raise ConfigError(
                f"{self.model}: its output {name} has the shape {value.shape} for {count} images; "
                "the first axis must be theirs"
            )
        return np.asarray(value, np.float32)

    def _open(self, runtime: Any, device: str) -> Any:
        tensorrt = any(map(importlib.util.find_spec, ("tensorrt", "tensorrt_libs")))
        wanted = providers(device, runtime.get_available_providers(), tensorrt=tensorrt)
        if len(wanted) > 1:  # the CUDA libraries that came with torch, or with packages of their own
            with contextlib.redirect_stdout(sys.stderr):  # it prints which libraries are missing
                runtime.preload_dlls()
        try:
            session = _session(self.model, runtime, wanted)
        except ConfigError:
            if device != "auto" or len(wanted) == 1:
                raise
            session = _session(self.model, runtime, wanted[-1:])  # the caller reports `device`
        if device != "auto" and DEVICES[device] not in session.get_providers():
            raise DeviceError(f"--device {device}: onnxruntime could not start it; --device cpu always works")
        return session

    def _check_input(self) -> tuple[str, Any, int]:
        """(name, dtype, batch size or 0 where it is free) of the input, if it is what the manifest says."""
        inputs = {node.name: node for node in self._session.get_inputs()}
        node = inputs.get(self._given.name or next(iter(inputs), ""))
        if node is None or len(inputs) > 1:
            has = ", ".join(inputs) or "none"
            wants = f"input.name is {self._given.name}" if self._given.name else "input is the only one"
            raise ConfigError(f"{self.model}: the manifest's {wants}; the model has {has}")
        if node.type not in _TYPES:
            raise ConfigError(f"{self.model}: its input {node.name} is a {node.type}; export it with float32")
        wide, tall = self._given.width, self._given.height
        size = (3, tall, wide) if self._given.layout == "NCHW" else (tall, wide, 3)
        fits = len(node.shape) == 4 and all(
            not isinstance(has, int) or has == wants for has, wants in zip(node.shape[1:], size, strict=True)
        )
        if not fits:
            shape = " x ".join(map(str, node.shape))
            raise ConfigError(
                f"{self.model}: its input {node.name} has the shape {shape}, but the manifest says "
                f"{self._given.layout} with {tall} x {wide}"
            )
        return node.name, _TYPES[node.type], node.shape[0] if isinstance(node.shape[0], int) else 0

    def _check_outputs(self) -> None:
        has = [node.name for node in self._session.get_outputs()]
        for name in self._outputs:
            if name not in has:
                raise ConfigError(f"{self.model}: it has no output {name}; its outputs are {', '.join(has)}")


def run_all(network: Network, images: NDArray[np.uint8], batch: int) -> dict[str, Floats]:
    """The outputs for images (N, h, w, 3), `batch` at a time, or the batch size that the network has."""
    size, parts = network.batch or batch, []
    for start in range(0, len(images), size):
        part = images[start : start + size]
        missing = size - len(part) if network.batch else 0
        filled = np.concatenate([part, np.repeat(part[-1:], missing, axis=0)]) if missing else part
        parts.append({name: value[: len(part)] for name, value in network.run(filled).items()})
    try:
        return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    except ValueError as error:
        raise ConfigError(f"{network.model}: its outputs differ in shape from batch to batch") from error


def providers(device: str, available: Sequence[str], *, tensorrt: bool) -> list[str]:
    """onnxruntime's providers for a device, best first; the CPU always comes last.

    Args: device, "auto" or one of DEVICES; available, what onnxruntime was built with; tensorrt, whether its
    library is installed: builds for GPUs name it in any case.

    Raises DeviceError: there is no such device, or this onnxruntime does not know it.
    """
    if device != "auto" and device not in DEVICES:
        raise DeviceError(f"--device {device}: choose auto, {', '.join(DEVICES)}")
    if device != "auto" and DEVICES[device] not in available:
        raise DeviceError(
            f"--device {device}: this onnxruntime cannot; install onnxruntime-gpu in place of onnxruntime"
        )
    order = ("tensorrt", "cuda", "cpu")
    usable = order if device == "auto" else order[order.index(device) :]
    if device == "auto" and not tensorrt:
        usable = usable[1:]
    return [DEVICES[name] for name in usable if DEVICES[name] in available]


def model_digest(model: Path, manifest: Path) -> str:
    """The SHA-256 of a model and its manifest in hexadecimal, as files record what they were made with."""
    # Models of more than 2 GiB keep their weights in a file of their own.
    weights = model.with_name(f"{model.name}.data")
    files = (model, manifest, *([weights] if weights.is_file() else []))
    return hashlib.sha256(b"".join(map(sha256, files))).hexdigest()


def describe_ends(model: Path) -> tuple[list[str], list[str]]:
    """`Network.ends` of a file without a manifest.

    Raises ConfigError: it is no network; DeviceError: onnxruntime is not installed.
    """
    return _ends(_session(model, _runtime(), [DEVICES["cpu"]]))


def _ends(session: Any) -> tuple[list[str], list[str]]:
    inputs, outputs = (
        [f"{it.name} ({it.type} {' x '.join(map(str, it.shape))})" for it in nodes]
        for nodes in (session.get_inputs(), session.get_outputs())
    )
    return inputs, outputs


def _session(model: Path, runtime: Any, wanted: list[str]) -> Any:
    """The session of an ONNX file on these providers. Raises ConfigError if onnxruntime cannot open it."""
    options = runtime.SessionOptions()
    options.log_severity_level = _FATAL
    runtime.set_default_logger_severity(_FATAL)
    try:  # onnxruntime's own fallback would print
        return runtime.InferenceSession(str(model), options, providers=wanted, enable_fallback=0)
    except _errors(runtime) as error:
        raise ConfigError(
            f"{model}: onnxruntime cannot open it with {wanted[0]}: {in_one_line(error, _LONGEST)}"
        ) from error


def _runtime() -> Any:
    try:
        import onnxruntime  # noqa: PLC0415  # see the module's docstring
    except ImportError as error:
        raise DeviceError(
            "networks need onnxruntime: pip install onnxruntime, or onnxruntime-gpu for an NVIDIA card"
        ) from error
    return onnxruntime


def _errors(runtime: Any) -> tuple[type[Exception], ...]:
    """onnxruntime's exceptions; they have no root of their own."""
    state = runtime.capi.onnxruntime_pybind11_state
    members = [getattr(state, name) for name in dir(state)]
    found = [it for it in members if isinstance(it, type) and issubclass(it, Exception)]
    return (*found, ValueError, RuntimeError, MemoryError)
