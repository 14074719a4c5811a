"""A network that decides between two explanations of a cloud, and knows more than what taught it.

It sees spin images and normals, as the cloud lies in the frame of either explanation, and is taught by what relief
decides (`two_ways.py`), or by which one fits better, in other proportions and with noise
(`training/surface_lessons.py`). No label is read. Its teachers see less: relief is a few numbers a part, and not where
on it they come from; fits are mean distances, and go wrong where registration got stuck. What they get wrong is not
wrong in the same way each time, what they get right is, and that is what a network learns.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceNetwork, SurfaceSize
from articulate_ssl.ops.spin_images import spin_images

# Of safes seen whole, a network that was taught with labels called one in ten upside down where it read 256 points, one
# in 24 where it reads 512 (docs/experiments.md, step 129).
SIZE = SurfaceSize(read=512, centers=256)
_ONCE_READ = 256  # by networks whose weights do not say
LOOKS = 2  # at other points of the cloud, whose odds are averaged; four and eight decide alike


class SurfaceDecision(SurfaceNetwork):
    """How right clouds look in some frame.

    Attributes:
        read: [] points of a cloud that it was taught to read, which weights say.
        temperature: [] by which odds are to be divided before they are believed (Guo et al. 2017): a network that is
            taught to the end is surer than it is right. Which explanation is likelier does not depend on it.
    """

    def __init__(self, size: SurfaceSize = SIZE) -> None:
        """Args: sizes."""
        super().__init__(size)
        self.size = size
        self.register_buffer("read", torch.tensor(size.read))
        self.right = nn.Linear(size.head_dim, 1)
        self.register_buffer("temperature", torch.tensor(1.0))

    def seen(
        self,
        seen: SurfaceCloud,
    ) -> Tensor:  # [B]
        """How right clouds look as they are seen."""
        return self.right(self.describe(seen)[1]).squeeze(-1)

    @torch.no_grad()
    def log_odds(
        self,
        frames: Tensor,  # [B, 2, 3, 3] of an explanation and of its twin -> camera
        dense: Tensor,  # [B, P, 3] farthest-point order
    ) -> Tensor:  # [B]
        """Logarithm of the odds that clouds look right in the first frame and not in the second."""
        one, other = self.looks_right(frames, dense).unbind(1)
        return one - other

    @torch.no_grad()
    def looks_right(
        self,
        frames: Tensor,  # [B, S, 3, 3] -> camera
        dense: Tensor,  # [B, P, 3] farthest-point order
    ) -> Tensor:  # [B, S]
        """How right whole clouds look in each frame, averaged over looks at different points."""
        looks = max(1, min(LOOKS, dense.shape[1] // self.size.read))
        points = dense[:, : looks * self.size.read]
        images, normal = spin_images(points, dense)
        found = []
        for first in range(looks):
            own = slice(first, None, looks)
            cloud = SurfaceCloud.of(points[:, own], images[:, own], normal[:, own], self.size)
            found.append(self.seen(cloud.seen_in(frames)).view(frames.shape[:2]))
        return torch.stack(found).mean(dim=0)


def surface_alone(
    clouds: Tensor,  # [B, P, 3]
    own: Tensor,  # [B, P] bool, some of each
    shown: int,
) -> tuple[Tensor, Tensor]:  # [B, S, 3], [B, S, SPIN_CHANNELS + 3]
    """The leading points of a piece, from the first again where there are fewer, and its surface without the rest."""
    points, surface = [], []
    for cloud, mine in zip(clouds, own, strict=True):
        seen = cloud[None, mine]
        leading, again = seen[:, :shown], torch.arange(shown, device=seen.device) % seen.shape[1]
        points.append(seen[:, again])
        surface.append(torch.cat(spin_images(leading, seen), dim=-1).half()[:, again])
    return torch.cat(points), torch.cat(surface)


class WithSurface(nn.Module):
    """What decides by a network if one was taught.

    Weights from before something was learnt lack it: buffers then stay as they are.

    Attributes:
        NETWORKS: Names of the networks that it may have.
    """

    NETWORKS: tuple[str, ...] = ("surface",)
    surface: SurfaceDecision | None

    def __init__(self) -> None:
        super().__init__()
        for name in self.NETWORKS:
            self.register_module(name, None)

    def _load_from_state_dict(self, state_dict: dict, prefix: str, *rest) -> None:
        like = next(buffer for buffer in self.buffers() if buffer.is_floating_point())
        for network in self.NETWORKS:
            setattr(self, network, None)
            if any(name.startswith(f"{prefix}{network}.") for name in state_dict):
                read = int(state_dict.setdefault(f"{prefix}{network}.read", torch.tensor(_ONCE_READ)))
                size = replace(SIZE, read=read, centers=read // 2)
                setattr(self, network, SurfaceDecision(size).to(like).requires_grad_(False))
        for name, value in self.named_buffers(recurse=False):
            state_dict.setdefault(prefix + name, value.clone())
        super()._load_from_state_dict(state_dict, prefix, *rest)
