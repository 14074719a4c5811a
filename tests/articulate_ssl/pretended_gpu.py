"""A GPU that is not there: tensors say that they are on it, are computed on the CPU, and must not meet CPU tensors.

    with pretended_gpu():
        module.to("cuda")
        module.predict_points(points.to("cuda"), ...)  # RuntimeError where a program would fail on a GPU

What a GPU refuses is refused: operations on tensors of both devices (but scalars, and indices in the host's memory),
and numpy's view of a tensor. Values are those of the CPU. Gradients and optimisers are not pretended.

    with pretended_gpu(), pretended_recording(): ...

refuses, too, what a GPU refuses while a CUDA graph is recorded: to read a value on the host, or to take one from there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode, resolve_name
from torch.utils._pytree import tree_flatten

GPU, CPU = torch.device("cuda", 0), torch.device("cpu")
_MARK = "pretended_device"  # attribute of a storage
_MOVES = {"to", "cuda", "cpu"}
_MOST_MATRICES = 65535  # of which eigenvectors are asked at once; with one more an H200's cuSOLVER failed
# What a recording refuses.
_READS = {"tolist", "item", "numpy", "__array__", "nonzero", "unique", "masked_select", "__contains__"} | {
    f"__{kind}__" for kind in ("bool", "float", "int", "index")
}
_FROM_HOST = {"tensor", "as_tensor", "new_tensor"}
# Operations that take tensors of both devices.
_BETWEEN = {"copy_", "__set__", "_has_compatible_shallow_copy_type"}


@contextmanager
def pretended_gpu() -> Iterator[None]:
    """See the module."""
    with (
        _PretendedGpu(),
        patch("torch.cuda.is_available", lambda: True),
        patch("torch.cuda.current_device", lambda: 0),
    ):
        yield


@contextmanager
def pretended_recording() -> Iterator[None]:
    """See the module."""
    with _PretendedRecording():
        yield


class _PretendedRecording(TorchFunctionMode):
    def __torch_function__(
        self, function: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(function, "__name__", "")
        tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
        on_gpu = [_PretendedGpu._device(x) == GPU for x in tensors]
        if any(on_gpu) and (name in _READS or (name in ("__getitem__", "__setitem__") and self._is_sought(args[1]))):
            raise RuntimeError(f"{name}: reads a value on the host, or takes one from there, in a recording")
        if name in _FROM_HOST and (any(on_gpu) or _as_device(kwargs.get("device")) == GPU):
            raise RuntimeError(f"{name}: takes a value from the host in a recording")
        out = function(*args, **kwargs)
        between = name in _MOVES or name in _BETWEEN
        if between and len({*on_gpu, *(_PretendedGpu._device(x) == GPU for x in (out,) if isinstance(x, Tensor))}) > 1:
            raise RuntimeError(f"{name}: from one device to the other in a recording")
        return out

    @staticmethod
    def _is_sought(index: Any) -> bool:
        """Whether an index is of the host, or says by values how many there are."""
        for x in index if isinstance(index, tuple) else (index,):
            if isinstance(x, list | bool):
                return True
            if isinstance(x, Tensor) and x.dim() and (x.dtype == torch.bool or _PretendedGpu._device(x) == CPU):
                return True
        return False


class _PretendedGpu(TorchFunctionMode):
    def __torch_function__(
        self, function: Callable, types: Any, args: tuple = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = dict(kwargs or {})
        name = getattr(function, "__name__", "")
        owner = getattr(getattr(function, "__self__", None), "__name__", "")
        if name == "__get__" and owner in ("device", "is_cuda"):
            return self._device(args[0]) if owner == "device" else self._device(args[0]) == GPU
        tensors = [x for x in tree_flatten((args, kwargs))[0] if isinstance(x, Tensor)]
        if name in _MOVES and tensors:
            return self._moved(function, name, args, kwargs)
        devices = {self._device(x) for x in tensors if not self._is_scalar(x)}
        if name in ("numpy", "__array__") and GPU in devices:
            raise TypeError("can't convert cuda:0 device type tensor to numpy")
        if name == "linalg_eigh" and GPU in devices and args[0].shape[:-2].numel() > _MOST_MATRICES:
            raise RuntimeError("cusolver error: CUSOLVER_STATUS_INTERNAL_ERROR")
        if name == "__getitem__" and self._device(args[0]) == GPU:
            devices = {GPU}
        if len(devices) > 1 and name not in _BETWEEN:
            raise RuntimeError(f"{resolve_name(function) or name}: tensors on cuda:0 and cpu")
        wanted = _as_device(kwargs.pop("device", None))
        out = function(*args, **kwargs)
        if wanted is None:
            wanted = self._device(args[0]) if name in _BETWEEN else self._of_result(tensors, devices)
        for x in out if isinstance(out, tuple | list) else (out,):
            if isinstance(x, Tensor):
                self._at(x, wanted)
        return out

    def _moved(self, function: Callable, name: str, args: tuple, kwargs: dict[str, Any]) -> Tensor:
        """`to`, `cuda` or `cpu` of a tensor: a copy, if that is elsewhere."""
        own = args[0]
        wanted = {"cuda": GPU, "cpu": CPU}.get(name) or _as_device(kwargs.pop("device", None))
        rest = []
        for x in args[1:]:
            if isinstance(x, Tensor):
                wanted = self._device(x)
            elif (device := _as_device(x)) is not None:
                wanted, x = device, CPU
            rest.append(x)
        wanted = wanted or self._device(own)
        found = function(own, *rest, **kwargs) if name == "to" and (rest or kwargs) else own
        if self._device(own) != wanted and found.data_ptr() == own.data_ptr():
            found = found.clone()
        return self._at(found, wanted)

    def _of_result(self, tensors: list[Tensor], devices: set[torch.device]) -> torch.device:
        """Of the tensors that are no scalars, or of all if all are."""
        devices = devices or {self._device(x) for x in tensors}
        return GPU if GPU in devices else CPU

    @staticmethod
    def _device(tensor: Tensor) -> torch.device:
        """Where it says it is, on the CPU without a mark; views share marks, which live as long as their storage."""
        with torch._C.DisableTorchFunction():
            return getattr(tensor.untyped_storage(), _MARK, CPU)

    @staticmethod
    def _at(tensor: Tensor, device: torch.device) -> Tensor:
        with torch._C.DisableTorchFunction():
            setattr(tensor.untyped_storage(), _MARK, device)
        return tensor

    @staticmethod
    def _is_scalar(tensor: Tensor) -> bool:
        with torch._C.DisableTorchFunction():
            return tensor.dim() == 0 or tensor.numel() == 0


def _as_device(x: Any) -> torch.device | None:
    """A device that an argument names, or None."""
    if isinstance(x, str) and x.split(":")[0] in ("cuda", "cpu"):
        x = torch.device(x)
    if isinstance(x, torch.device):
        return GPU if x.type == "cuda" else x
    return None
