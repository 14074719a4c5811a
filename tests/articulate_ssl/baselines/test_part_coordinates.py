import roma
import torch

from articulate_ssl.baselines.part_coordinates import ransac_poses
from articulate_ssl.geometry.se3 import se3, transform_points
from articulate_ssl.shape.part_poses import rigid_fit


def poses(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    quaternion = torch.randn(count, 4, generator=generator)
    rotation = roma.unitquat_to_rotmat(quaternion / quaternion.norm(dim=-1, keepdim=True))
    return se3(rotation, torch.randn(count, 3, generator=generator))


def test_ransac_survives_a_third_of_outliers_and_points_of_other_parts():
    torch.manual_seed(0)
    coordinates, pose = 0.3 * torch.randn(3, 2, 90, 3), poses(6).view(3, 2, 4, 4)
    part_id = torch.arange(90) % 2
    posed = transform_points(pose, coordinates)
    points = posed.gather(1, part_id.expand(3, -1)[:, None, :, None].expand(-1, -1, -1, 3)).squeeze(1)
    wrong = coordinates.clone()
    wrong[:, :, ::3] += torch.randn(3, 2, 30, 3)
    weight = torch.nn.functional.one_hot(part_id, 2).T.float().expand(3, -1, -1)
    torch.testing.assert_close(ransac_poses(wrong, points, weight), pose, atol=1e-3, rtol=0)
    least_squares = rigid_fit(wrong, points[:, None].expand(-1, 2, -1, -1), weight)
    assert (least_squares - pose).abs().max() > 0.1


def test_a_part_without_points_has_a_finite_pose():
    points = torch.randn(2, 40, 3)
    weight = torch.stack([torch.ones(2, 40), torch.zeros(2, 40)], dim=1)
    assert ransac_poses(torch.zeros(2, 2, 40, 3), points, weight).isfinite().all()
