"""Mirror images of a category's objects: safes that are hinged on the other side.

No rotation turns one hand into the other, and a category has one joint. But the mirror image of a cloud is a cloud of
the mirrored object: predicted in the mirror, and mirrored back, it is explained by the category's mirror image. Where
a camera is held upright, that differs from every orientation of the category itself; in any orientation it does not,
as a safe upside down is hinged on the other side.

Whether a category has two hands shows in training clouds, without labels: in how much better or worse each is
explained in the mirror. Of one hand that is +mu, of the other -mu, give or take sigma. From both and from how
often either is seen follow the odds of a cloud.
"""

from __future__ import annotations

import logging
from dataclasses import fields, replace

import torch
from torch import Tensor

from articulate_ssl.geometry.screw import REVOLUTE
from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.late_buffers import LateBuffers
from articulate_ssl.inference.prediction import Prediction
from articulate_ssl.ops.progress import tell

FEWEST = 60  # clouds from which it is learnt
_CAMERA_MIRROR = (-1.0, 1.0, 1.0)  # left and right of a camera that is held upright change places
# Of a category of two hands: distance between the two kinds of clouds, in standard deviations of one, and share of the
# mirrored ones. Measured: safes 3.0 to 4.2, 8 to 10 % (docs/experiments.md, step 77). Chosen, as is the next.
_LEAST_DISTANCE, _LEAST_SHARE = 2.5, 0.02
_OUTLYING = 3.0  # medians, beyond which a difference counts as this far
_ROUNDS = 100  # of expectation and maximisation

log = logging.getLogger(__name__)


class Handedness(LateBuffers):
    """Whether a cloud shows the category's mirror image.

    Attributes:
        learnt: [] whether the category has two hands; if not, nothing is looked at in the mirror.
        normal: [3] unit, of the plane in canonical object space whose mirror image of an object stands as the object.
        slope: [] of the logarithm of the odds, by the logarithm of the ratio of errors.
        offset: [] where the errors are the same.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("learnt", torch.tensor(False))
        self.register_buffer("normal", torch.tensor([1.0, 0.0, 0.0]))
        self.register_buffer("slope", torch.tensor(0.0))
        self.register_buffer("offset", torch.tensor(0.0))

    def hands(
        self,
        clouds: Tensor,  # [B, N, 3]
    ) -> Tensor:  # [B, N, 3], or [2 B, N, 3] as of `both_hands`
        """What has to be explained of clouds: in the mirror, too, if the category has two hands."""
        return both_hands(clouds) if self.learnt else clouds

    def log_odds(
        self,
        error: Tensor,  # [B] of predictions
        mirrored: Tensor,  # [B] of those of the mirror images
    ) -> Tensor:  # [B]
        """That clouds show the mirror image."""
        return self.slope * (error / mirrored).log() + self.offset

    @torch.no_grad()
    def learn(
        self,
        error: Tensor,  # [n] of training clouds
        mirrored: Tensor,  # [n]
        axes: Tensor,  # [3, 3] columns: of the object, in canonical object space
    ) -> None:
        """Find out whether the clouds are of two kinds, and how these differ."""
        if len(error) < FEWEST:
            return
        ratio = (error / mirrored).log().double().cpu()
        far = _OUTLYING * ratio.abs().median()
        mean, deviation, share = two_kinds(ratio.clamp(-far, far))
        distance = float(2 * mean / deviation)
        tell(
            log, "in the mirror: two kinds of clouds %.1f deviations apart, %.0f %% the mirrored", distance, 100 * share
        )
        if distance < _LEAST_DISTANCE or share < _LEAST_SHARE:
            return
        sideways = axes[0].abs().argmax()  # upright objects stand in the mirror as they do before it
        self.normal.copy_(axes[:, sideways])
        self.slope.copy_(2 * mean / deviation**2)
        self.offset.copy_((share / (1 - share)).log())
        self.learnt.fill_(True)

    def mirrored_back(self, prediction: Prediction) -> Prediction:
        """What the prediction of a mirrored cloud says about the cloud."""
        like = prediction.part_pose
        camera = torch.diag(torch.tensor(_CAMERA_MIRROR)).to(like)
        own = (torch.eye(3).to(self.normal) - 2 * torch.outer(self.normal, self.normal)).to(like)

        def back(pose: Tensor) -> Tensor:
            return se3(camera @ pose[..., :3, :3] @ own, pose[..., :3, 3] @ camera)

        # A rotation turns the other way in the mirror: about the mirrored axis, reversed, by the same angle.
        sign = torch.where(prediction.joint_type == REVOLUTE, -1.0, 1.0)[..., None].to(camera)
        return replace(
            prediction,
            part_pose=back(prediction.part_pose),
            base_pose=back(prediction.base_pose),
            part_shape=prediction.part_shape @ own,
            assembly=prediction.assembly @ own,
            joint_axis=sign * (prediction.joint_axis @ camera),
            joint_pivot=prediction.joint_pivot @ camera,
            canonical_axis=sign * (prediction.canonical_axis @ own),
            canonical_pivot=prediction.canonical_pivot @ own,
        )

    def likelier(
        self,
        seen: tuple[Prediction, Prediction],  # of clouds, and their rivals
        mirrored: tuple[Prediction, Prediction],  # of their mirror images
        odds: Tensor,  # [B] logarithm of those of the latter
    ) -> tuple[Prediction, Prediction]:
        """Of each cloud the pair whose hand is likelier, with a margin that is no larger than that says."""
        chosen, rival = (
            _either(odds > 0, self.mirrored_back(there), here) for here, there in zip(seen, mirrored, strict=True)
        )
        return replace(chosen, margin=chosen.margin.minimum((odds.abs() / 2).tanh())), rival


def in_the_mirror(points: Tensor) -> Tensor:
    """Clouds [..., 3] as an upright camera would see them in a mirror."""
    return points * torch.tensor(_CAMERA_MIRROR).to(points)


def both_hands(
    clouds: Tensor,  # [B, N, 3]
) -> Tensor:  # [2 B, N, 3]
    """Clouds, and after them what they are in the mirror: one batch, which for few clouds takes little longer."""
    return torch.cat([clouds, in_the_mirror(clouds)])


def two_kinds(
    values: Tensor,  # [n]
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean of the positive kind, deviation of either and share of the positive one, of clouds of +-mean.

    Expectation maximisation of a mixture of two normal distributions, each the other's mirror image.
    """
    mean, deviation, share = values.abs().mean(), values.std() / 2, (values > 0).double().mean()
    for _ in range(_ROUNDS):
        odds = 2 * mean * values / deviation**2 + share.clamp(1e-6, 1 - 1e-6).logit()
        positive = odds.sigmoid()
        signed = (2 * positive - 1) * values
        mean, share = signed.mean(), positive.mean()
        deviation = (values.square().mean() - mean**2).clamp_min(1e-12).sqrt()
    return mean, deviation, share


def _either(first: Tensor, one: Prediction, other: Prediction) -> Prediction:
    """Of every cloud the one or the other."""
    names = [field.name for field in fields(Prediction)]
    return Prediction(
        **{
            name: torch.where(
                first.view(-1, *[1] * (getattr(one, name).dim() - 1)), getattr(one, name), getattr(other, name)
            )
            for name in names
        }
    )
