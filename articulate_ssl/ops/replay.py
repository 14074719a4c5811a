"""What a GPU did once, done again as one: for few clouds, starting its kernels takes longer than they run."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterable
from typing import Generic, TypeVar

import torch
from torch import Tensor

_MOST_CLOUDS = 4  # with more, kernels take longer than their start, and every recording keeps memory of its own
_MOST_RECORDINGS = 4
_WARM_UP = 2  # runs before a recording, in which kernels are chosen

Result = TypeVar("Result")


class Replay(Generic[Result]):
    """Functions of clouds, recorded on a GPU as CUDA graphs when they are asked the same for the second time.

    A replay does what was done then, with the values that all tensors have now. So a function must read no value on
    the host and take none from it, and what it depends on beside its clouds and weights has to be said in every call.
    On a CPU, with gradients, or of more than `_MOST_CLOUDS` clouds functions are called as they are.

    Args:
        weights: All tensors that functions read; with others in their place they are recorded anew.
        copied: A copy of a result, since the next replay writes over it.
    """

    def __init__(self, weights: Callable[[], Iterable[Tensor]], copied: Callable[[Result], Result]) -> None:
        self._weights, self._copied = weights, copied
        self._asked: Hashable = None
        self._recordings: dict[Hashable, Callable[[Tensor], Result]] = {}

    def __call__(
        self,
        function: Callable[[Tensor], Result],
        points: Tensor,  # [B, N, 3]
        about: Hashable,
    ) -> Result:
        """Its result; `about` is all that it depends on beside clouds and weights."""
        if not points.is_cuda or torch.is_grad_enabled() or len(points) > _MOST_CLOUDS:
            return function(points)
        mode = torch.is_inference_mode_enabled(), torch.is_autocast_enabled("cuda"), torch.get_autocast_dtype("cuda")
        places = tuple(tensor.data_ptr() for tensor in self._weights())
        asked = tuple(points.shape), points.dtype, points.device, mode, places, about
        if asked not in self._recordings:
            if asked != self._asked:  # one cloud alone is not worth it
                self._asked = asked
                return function(points)
            if len(self._recordings) == _MOST_RECORDINGS:
                del self._recordings[next(iter(self._recordings))]
            self._recordings[asked] = recorded(function, points)
        return self._copied(self._recordings[asked](points))


def recorded(function: Callable[[Tensor], Result], points: Tensor) -> Callable[[Tensor], Result]:
    """The function as a CUDA graph, for clouds of this shape; every call writes over the last one's result."""
    own, graph = points.clone(), torch.cuda.CUDAGraph()
    # What an outer autocast casts and keeps would be gone when that ends.
    with torch.autocast("cuda", enabled=torch.is_autocast_enabled("cuda"), cache_enabled=False):
        aside = torch.cuda.Stream()
        aside.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(aside):
            for _ in range(_WARM_UP):
                function(own)
        torch.cuda.current_stream().wait_stream(aside)
        with torch.cuda.graph(graph):
            result = function(own)

    def replay(clouds: Tensor) -> Result:
        own.copy_(clouds)
        graph.replay()
        return result

    return replay
