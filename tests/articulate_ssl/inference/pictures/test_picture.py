import matplotlib.image
import numpy as np
import pytest
import synthetic_predictions as synthetic
import torch
from matplotlib.collections import TriMesh

from articulate_ssl.geometry.se3 import se3
from articulate_ssl.inference.articulation import to_input_frame
from articulate_ssl.inference.pictures.picture import (
    SampleRow,
    draw_prediction,
    draw_test_samples,
    prediction_figure,
    samples_figure,
)
from articulate_ssl.inference.prediction import Prediction

RANGE = torch.tensor([[0.16, 1.73]])
SLIDE = torch.tensor([[0.0, 0.3]]).repeat(3, 1)


def titles(figure) -> list[str]:
    return [ax.get_title() for ax in figure.axes]


def drawn(ax) -> np.ndarray:
    """[N, 2] discs of a panel with a scan, corners of the triangles of one with surfaces."""
    (collection,) = ax.collections
    if isinstance(collection, TriMesh):
        return np.column_stack([collection._triangulation.x, collection._triangulation.y])
    return np.asarray(collection.get_offsets())


def test_six_panels_for_a_hinge():
    prediction, points = synthetic.laptop()
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), RANGE)
    assert titles(figure) == [
        "Input, by predicted part",
        "Reconstruction",
        "Canonical object and joints",
        "Articulated to 9°",
        "Articulated to 54°",
        "Articulated to 99°",
    ]
    assert [len(ax.texts) for ax in figure.axes] == [0, 0, 1, 0, 0, 0]  # the one arrow
    assert len(drawn(figure.axes[0])) == len(points)


def test_all_panels_share_one_view_and_one_scale():
    prediction, points = synthetic.laptop()
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), RANGE)
    assert len({(*ax.get_xlim(), *ax.get_ylim()) for ax in figure.axes}) == 1
    assert all(ax.get_aspect() == 1 for ax in figure.axes)
    for ax in figure.axes:  # nothing is cut off
        offsets = drawn(ax)
        assert (offsets.min(axis=0) >= (ax.get_xlim()[0], ax.get_ylim()[0])).all()
        assert (offsets.max(axis=0) <= (ax.get_xlim()[1], ax.get_ylim()[1])).all()
    # The base, which is lower than the lid, does not move.
    low, high = (drawn(figure.axes[i])[:, 1].min() for i in (3, 5))
    assert low == pytest.approx(high)


def test_the_scan_is_drawn_as_points_and_the_object_as_surfaces():
    prediction, points = synthetic.laptop()
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), RANGE)
    kinds = [isinstance(ax.collections[0], TriMesh) for ax in figure.axes]
    assert kinds == [False, True, True, True, True, True]


def test_reconstruction_is_drawn_where_the_parts_are_posed():
    prediction, points = synthetic.laptop()
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), RANGE)
    for end in (np.min, np.max):
        np.testing.assert_allclose(
            end(drawn(figure.axes[1]), axis=0), end(drawn(figure.axes[0]), axis=0), atol=0.06
        )  # the cloud has other points of the same surface


def test_an_upright_object_is_seen_from_another_side():
    prediction, points = synthetic.laptop()
    arguments = prediction, points.numpy(), prediction.part_id[0].numpy(), RANGE
    upright, free = (drawn(prediction_figure(*arguments, upright).axes[0]) for upright in (True, False))
    assert np.abs(np.sort(upright, axis=0) - np.sort(free, axis=0)).max() > 0.05


def test_an_arrow_per_joint_and_metric_sliding_states():
    prediction, points = synthetic.drawer()
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), SLIDE)
    assert len(figure.axes[2].texts) == 3
    assert titles(figure)[3:] == ["Articulated to 0", "Articulated to 0.15", "Articulated to 0.3"]


def test_the_picture_does_not_depend_on_the_pose_and_unit_of_the_scan():
    prediction, points = synthetic.laptop()
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), RANGE)
    metric = to_input_frame(prediction, torch.tensor([5.0, 6.0, 7.0]), 2.0)
    turn = se3(synthetic.random_rotation(9).double(), torch.zeros(3, dtype=torch.float64))
    metric = Prediction(
        **{**vars(metric), "base_pose": turn @ metric.base_pose, "part_pose": turn @ metric.part_pose},
    )
    moved = (points.double() * 2 + torch.tensor([5.0, 6.0, 7.0])) @ turn[:3, :3].T
    again = prediction_figure(metric, moved.numpy(), prediction.part_id[0].numpy(), RANGE)
    for a, b in zip(figure.axes, again.axes, strict=True):
        for end in (np.min, np.max):
            np.testing.assert_allclose(end(drawn(b), axis=0), 2 * end(drawn(a), axis=0), atol=1e-3)


def test_degenerate_predictions_are_drawn():
    for make, limits in ((synthetic.laptop, RANGE), (synthetic.drawer, SLIDE)):
        prediction, points = make()
        nothing = {n: torch.zeros_like(getattr(prediction, n)) for n in ("part_shape", "assembly", "canonical_pivot")}
        collapsed = Prediction(**{**vars(prediction), **nothing})
        figure = prediction_figure(collapsed, points.numpy(), np.zeros(len(points), dtype=int), limits)
        assert len(figure.axes) == 6


def test_an_object_of_one_part_has_three_panels():
    prediction, points = synthetic.chain_of_boxes([((0.8, 0.5, 0.1), (0, 0, 0))], [], [])
    figure = prediction_figure(prediction, points.numpy(), prediction.part_id[0].numpy(), torch.empty(0, 2))
    assert len(figure.axes) == 3


def test_files_are_pngs_with_ink(tmp_path):
    prediction, points = synthetic.laptop()
    part_id = prediction.part_id[0].numpy()
    draw_prediction(prediction, points.numpy(), part_id, RANGE, False, tmp_path / "p.png")
    rows = [SampleRow("best", points.numpy(), prediction, part_id), SampleRow("worst", points.numpy(), prediction)]
    draw_test_samples(rows, tmp_path / "t.png")
    for name in ("p.png", "t.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        image = matplotlib.image.imread(tmp_path / name)
        assert 0.1 < (image[..., :3].min(axis=-1) < 0.9).mean() < 0.8
    assert sorted(p.name for p in tmp_path.iterdir()) == ["p.png", "t.png"]


def test_sample_rows_are_titled_and_grey_without_truth():
    prediction, points = synthetic.laptop()
    rows = [SampleRow(t, points.numpy(), prediction) for t in ("best: 1°", "median: 3°", "worst: 170°")]
    figure = samples_figure(rows)
    assert len(figure.axes) == 9
    assert [ax.get_title(loc="left") for ax in figure.axes[::3]] == ["best: 1°", "median: 3°", "worst: 170°"]
    truth, predicted = (np.asarray(figure.axes[i].collections[0].get_facecolors())[:, :3] for i in (0, 1))
    assert np.ptp(truth, axis=1).max() < 1e-6 < np.ptp(predicted, axis=1).min()
