"""How `inference.surface_decision` is taught: by clouds of which it is mostly known which explanation is right.

No label is read. Of a cloud both frames are known, that of the explanation which the teacher favours, relief or fits,
and that of the other. Every time a cloud is shown, it is of other points, in other proportions along the frames' axes,
its frames are turned a little, as registration turns them, and half of the times its points carry noise.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass

import roma
import torch
from torch import Tensor, nn
from torch.nn import functional

from articulate_ssl.inference.surface_decision import SIZE, SurfaceDecision
from articulate_ssl.network.surface_network import SurfaceCloud, SurfaceSize
from articulate_ssl.ops.progress import announced, tell
from articulate_ssl.ops.spin_images import SPIN_CHANNELS, spin_images

# Chosen on training objects that were left out and on development objects (steps 109 and 112 of docs/experiments.md).
TAUGHT = 0.8  # of the clouds; the others say whether the network is right
# How often each cloud is shown. Longer, and what the teacher gets wrong is learnt by heart: taught by 291 clouds of
# eyeglasses, 7 % of them wrongly, it turns over .4 % of others after 22 times, 1.0 % after 44 (step 113).
TIMES = 20
BATCH, RATE = 32, 2e-3
FEWEST = 200  # clouds that teach. Chosen.
_DECAY, _GRADIENT_NORM = 1e-4, 1.0
_CHUNK = 64  # clouds at a time
_TEMPERATURES = 61  # from a tenth to a hundred, that are tried
_SHOWN = 2  # times as many points as the network reads are known, of which it reads some
_STRETCH = 0.15  # standard deviation of the logarithm of an axis' stretch
_TURN = 0.1  # radians a direction, by which frames are turned

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Lessons:
    """Clouds of which it is known which of two or more frames is right.

    Attributes:
        points: [V, n, N, 3] V versions of each cloud: as it is, with noise.
        surface: [V, n, N, SPIN_CHANNELS + 3] float16, spin images and normals.
        frames: [n, S, 3, 3] the right one first.
        mirrored: Every look is in a mirror half of the times, with the frames' second axis reversed.
        doubt: Share of the lessons that may be wrong. What contradicts all others is then not learnt by heart.
    """

    points: Tensor
    surface: Tensor
    frames: Tensor
    mirrored: bool = False
    doubt: float = 0.0

    @staticmethod
    @torch.no_grad()
    def of(
        versions: Sequence[Tensor],  # of [n, P, 3] dense, farthest-point order
        frames: Tensor,  # [n, S, 3, 3]
    ) -> Lessons:
        """From clouds and all their frames."""
        count = _SHOWN * SIZE.read
        dense = torch.cat(list(versions))
        shown = announced(log, "surfaces of clouds that teach", dense.split(_CHUNK))
        surface = [torch.cat(spin_images(some[:, :count], some), dim=-1).half() for some in shown]
        ways = (len(versions), -1)
        return Lessons(dense[:, :count].unflatten(0, ways), torch.cat(surface).unflatten(0, ways), frames)

    def draw(self, count: int, size: SurfaceSize, generator: torch.Generator) -> tuple[SurfaceCloud, Tensor]:
        """Some of the clouds, in versions and of points drawn anew; and the right and a wrong frame of each."""
        versions, clouds, shown, _ = self.points.shape
        chosen = torch.randperm(clouds, generator=generator)[:count, None]
        version = torch.randint(versions, chosen.shape, generator=generator)
        seen = drawn_points(len(chosen), shown, size.read, generator)
        frames = self.frames[chosen[:, 0]]
        if frames.shape[1] > 2:
            wrong = torch.randint(1, frames.shape[1], (len(frames),), generator=generator)
            frames = torch.stack([frames[:, 0], frames[torch.arange(len(frames)), wrong]], dim=1)
        return self.cloud((version, chosen, seen), size), frames

    def cloud(self, where: tuple[Tensor, ...], size: SurfaceSize) -> SurfaceCloud:
        """Points and surface at indices of the leading dimensions."""
        points, surface = (x[where].to(self.points) for x in (self.points, self.surface))
        return SurfaceCloud.of(points, *surface.split([SPIN_CHANNELS, 3], dim=-1), size)


def drawn_points(count: int, shown: int, read: int, generator: torch.Generator) -> Tensor:  # [count, read]
    """Some of the points of every cloud, in farthest-point order again, so that what is left after a layer is even."""
    return torch.rand(count, shown, generator=generator).argsort(dim=1)[:, :read].sort(dim=1).values


def learn_surface(
    versions: Sequence[Tensor],  # of [n, P, 3] dense, farthest-point order: clouds as they are first
    frames: Tensor,  # [n, S, 3, 3] -> camera, of the explanation that a teacher favours first
    order: Tensor,  # [m] clouds that the teacher knows something of: of those to be taught by first
    least: float,
) -> SurfaceDecision | None:
    """A network taught by the leading clouds; None, if of the others it says too seldom what the teacher says.

    Args:
        least: That share.
    """
    taught, rest = order.split([count := int(TAUGHT * len(order)), len(order) - count])
    if len(taught) < FEWEST:
        tell(log, "no network decides: that takes %d clouds to teach it, there are %d", FEWEST, len(taught))
        return None
    decision = teach(Lessons.of([clouds[taught] for clouds in versions], frames[taught]))
    said = torch.cat(
        [
            decision.looks_right(*some)
            for some in zip(frames[rest].split(_CHUNK), versions[0][rest].split(_CHUNK), strict=True)
        ]
    )
    agrees = float((said.argmax(dim=1) == 0).double().mean())
    tell(log, "a network taught by %d clouds says of %.0f %% of the others what taught it", len(taught), 100 * agrees)
    if agrees < least:
        log.warning("that is too few: no network decides")
        return None
    decision.temperature.copy_(believable(said[:, 0] - said[:, 1:].logsumexp(dim=1)))
    return decision


def believable(odds: Tensor) -> Tensor:
    """The temperature [] at which the odds [m] of what is held to be right surprise the least."""
    temperatures = torch.logspace(-1, 2, _TEMPERATURES).to(odds)
    return temperatures[functional.softplus(-odds[:, None] / temperatures).mean(dim=0).argmin()]


def teach(
    lessons: Lessons,
    work: str = "a network learns to decide",
    size: SurfaceSize | None = None,
    times: int | None = None,
) -> SurfaceDecision:
    """A new network that has learnt them.

    Args:
        work: What progress is called.
        size: Of the network; None is that of a decision between two explanations.
        times: How often each cloud is shown; None is `TIMES`.
    """
    size = size or SIZE
    device = lessons.points.device
    generator = torch.Generator().manual_seed(0)
    steps = math.ceil((times or TIMES) * lessons.points.shape[1] / BATCH)
    with torch.random.fork_rng(devices=[]), torch.enable_grad():
        torch.manual_seed(0)
        decision = SurfaceDecision(size).to(device)
        optimizer = torch.optim.AdamW(decision.parameters(), lr=RATE, weight_decay=_DECAY)
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
        for _ in announced(log, work, range(steps)):
            cloud, frames = lessons.draw(BATCH, size, generator)
            shown = _varied(cloud.seen_in(_turned(frames, generator)), lessons.mirrored, generator)
            one, other = decision.seen(shown).view(-1, 2).unbind(1)
            loss = -_believed(one - other, lessons.doubt).mean()
            optimizer.zero_grad()
            loss.backward()
            nn.utils.clip_grad_norm_(decision.parameters(), _GRADIENT_NORM)
            optimizer.step()
            schedule.step()
    return decision.eval().requires_grad_(False)


def _believed(odds: Tensor, doubt: float) -> Tensor:
    """Logarithm of the probability that a lesson says what it says, which may be wrong."""
    if doubt == 0:
        return functional.logsigmoid(odds)
    right, wrong = functional.logsigmoid(odds), functional.logsigmoid(-odds)
    return torch.logaddexp(right + math.log1p(-doubt), wrong + math.log(doubt))


def _turned(frames: Tensor, generator: torch.Generator) -> Tensor:
    """Frames [B, 2, 3, 3], each turned a little."""
    vector = _TURN * torch.randn(*frames.shape[:2], 3, generator=generator)
    return frames @ roma.rotvec_to_rotmat(vector).to(frames)


def _varied(seen: SurfaceCloud, mirrored: bool, generator: torch.Generator) -> SurfaceCloud:
    """Clouds as they are seen, in other proportions along the axes of their frames, and some in the mirror."""
    stretch = (_STRETCH * torch.randn(len(seen.points), 1, 3, generator=generator)).exp().to(seen.points)
    if mirrored:
        stretch[torch.rand(len(stretch), generator=generator) < 0.5, :, 1] *= -1
    return seen._replace(points=seen.points * stretch, normal=functional.normalize(seen.normal / stretch, dim=-1))
