"""What the segmentation methods without labels share: they encode a cloud, and say what of space a shape fills.

BAE-Net, NSD and BSP-Net learn from occupancy samples (`render.occupancy`): points of which it is known whether they lie
inside. Their own encoders read voxels or pictures; a cloud under test has neither, so all three read the cloud with a
PointNet. They assume aligned objects, and are given objects in any pose here, as in the paper.
"""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, one_hot

from articulate_ssl.baselines.method import OCCUPANCY, PART_LABELS, SEGMENTATION, Method, Problem, no_joints
from articulate_ssl.inference.prediction import Prediction
from datamodules.articulated_data_module import ArticulatedDataModule

# Lengths are multiplied by this before a layer reads them, as in NSD's code: objects of diagonal 1 are small.
COORDINATES = 6.0
SLOPE = 0.02  # of leaky rectifiers, as in IM-NET's and BAE-Net's networks
# Occupancy samples of a cloud that one step reads, of all that there are. Chosen without a measurement.
SAMPLES_PER_STEP = 512
# Labelled training clouds that test clouds are compared with, each in one pose. Chosen without a measurement.
GALLERY = 1024
# Points by which two clouds are compared.
SIMILARITY_POINTS = 64
# Weight of other clouds' votes on a primitive that the most similar cloud does not use: they decide only then.
OTHERS = 1e-6


class CloudEncoder(nn.Module):
    """PointNet (Qi et al. 2017) of two stages; the second sees every point beside the first one's pooled features.

    Args:
        code: Length of the code.
        width: Channels of the first layer; the later ones have two and four times as many.
    """

    def __init__(self, code: int, width: int = 48) -> None:
        super().__init__()
        self.local = nn.Sequential(nn.Linear(3, width), nn.LeakyReLU(SLOPE), nn.Linear(width, 2 * width))
        self.joint = nn.Sequential(
            nn.Linear(4 * width, 4 * width), nn.LeakyReLU(SLOPE), nn.Linear(4 * width, 4 * width)
        )
        self.code = nn.Linear(4 * width, code)

    def forward(
        self,
        points: Tensor,  # [B, N, 3]
    ) -> Tensor:  # [B, code]
        """One code for each cloud."""
        local = leaky_relu(self.local(COORDINATES * points), SLOPE)
        pooled = local.amax(1, keepdim=True).expand_as(local)
        return self.code(leaky_relu(self.joint(torch.cat([local, pooled], dim=-1)).amax(1), SLOPE))


def draw_samples(batch: dict[str, Tensor], count: int = SAMPLES_PER_STEP) -> tuple[Tensor, Tensor]:
    """Some of a batch's occupancy samples, the same of every cloud: [B, M, 3] and [B, M].

    Raises:
        ValueError: if the batch has none.
    """
    if "occupancy" not in batch:
        raise ValueError(
            "the batch has no occupancy samples: make the set with `--occupancy 2048` (render.generate) and open it "
            "with ArticulatedDataModule(occupancy=True)"
        )
    points, occupancy = batch["occupancy_points"], batch["occupancy"]
    chosen = torch.randperm(points.shape[1])[:count].to(points.device)
    return points[:, chosen], occupancy[:, chosen]


def segmentation(
    points: Tensor,  # [B, N, 3]
    part_probability: Tensor,  # [B, N, K]
) -> Prediction:
    """Parts of points as a prediction that says nothing else: no motion, no shape, no joints (J = 0)."""
    clouds, _, num_parts = part_probability.shape
    identity = torch.eye(4, dtype=points.dtype, device=points.device)
    return Prediction(
        part_id=part_probability.argmax(-1),
        part_probability=part_probability,
        part_pose=identity.expand(clouds, num_parts, 4, 4),
        part_shape=points.new_zeros(clouds, num_parts, 1, 3),
        assembly=points.new_zeros(clouds, num_parts, 3),
        base_pose=identity.expand(clouds, 4, 4),
        reconstruction_error=points.new_zeros(clouds),
        margin=points.new_ones(clouds),
        **no_joints(points),
    )


def cloud_distances(
    points: Tensor,  # [B, N, 3]
    others: Tensor,  # [G, N', 3]
) -> Tensor:  # [B, G]
    """Squared Chamfer distance of every cloud to every other, by the first `SIMILARITY_POINTS` of each."""
    points, others = points[:, :SIMILARITY_POINTS], others[:, :SIMILARITY_POINTS]
    target = others.flatten(0, 1)  # [G N', 3]
    rows = []
    for cloud in points:
        square = torch.cdist(cloud, target).square().view(len(cloud), *others.shape[:2])  # [N, G, N']
        rows.append(square.amin(0).mean(-1) + square.amin(2).mean(0))
    return torch.stack(rows)


class PrimitiveMethod(Method):
    """A method whose shapes are unions of C primitives in a fixed order, C larger than the number of parts.

    Which part a primitive belongs to is read off training shapes with labels: a primitive is the part that most points
    of the shape in it belong to. With objects in any pose, a primitive is not the same part everywhere. The paper
    (appendix "Implementation details for baselines", BSP-Net and NSD) therefore takes, for each test shape, the
    relation of the training shape that is most similar to it. Decided here, as the paper does not say: the most similar
    is that of smallest Chamfer distance among `GALLERY` training clouds, each in one pose; a primitive that it does not
    use is what it is in most others.

    This is no segmentation without labels any more: it reads the part of every point of `GALLERY` training clouds
    (`given` says so), and part of what it scores is the nearest labelled cloud's and not the network's.
    """

    given = (OCCUPANCY, PART_LABELS)
    says = (SEGMENTATION,)
    labelled_spaces = True

    def __init__(self, problem: Problem, num_primitives: int) -> None:
        super().__init__(problem)
        self.num_primitives = num_primitives
        self.register_buffer("gallery_points", torch.zeros(0, problem.num_points, 3))
        self.register_buffer("gallery_part", torch.zeros(0, problem.num_points, dtype=torch.long))
        self.register_buffer("gallery_votes", torch.zeros(0, num_primitives, problem.num_parts))

    @abstractmethod
    def primitive_of(
        self,
        points: Tensor,  # [B, N, 3]
    ) -> Tensor:  # [B, N] int64
        """The primitive that every point of a cloud belongs to."""

    def prepare(self, data: ArticulatedDataModule, seed: int) -> None:
        """Keep training clouds with the part of every point; training itself does not read them."""
        batches = list(data.discovery_dataloader(GALLERY))
        count = self.problem.num_points
        self.gallery_points = torch.cat([batch["points"] for batch in batches])
        self.gallery_part = torch.cat([batch["dense_part_id"][:, :count] for batch in batches])

    @torch.no_grad()
    def on_train_end(self) -> None:
        """Count, for every cloud of the gallery, how many points of each part each primitive has."""
        votes = []
        for points, part in zip(self.gallery_points.split(16), self.gallery_part.split(16), strict=True):
            pair = self.primitive_of(points) * self.problem.num_parts + part  # [B, N]
            counted = one_hot(pair, self.num_primitives * self.problem.num_parts).sum(1)
            votes.append(counted.view(len(points), self.num_primitives, self.problem.num_parts))
        self.gallery_votes = torch.cat(votes).float()

    @torch.no_grad()
    def predict(self, batch: dict[str, Tensor]) -> Prediction:
        """Primitives of the points, and the parts that they are in the most similar training cloud.

        Raises:
            RuntimeError: if it has not been trained.
        """
        if len(self.gallery_votes) == 0:
            raise RuntimeError(f"{self.title} is not trained: train it with `articulate_ssl.baselines.runner.train`")
        points = batch["points"]
        nearest = cloud_distances(points, self.gallery_points).argmin(1)
        votes = self.gallery_votes[nearest] + OTHERS * self.gallery_votes.sum(0)  # [B, C, K]
        part = votes.argmax(-1).gather(1, self.primitive_of(points))
        return segmentation(points, one_hot(part, self.problem.num_parts).to(points.dtype))
