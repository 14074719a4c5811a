import numpy as np
import pytest
import synthetic_predictions as synthetic
import trimesh
from scan_predictions import CENTER, OBJECTS, SCALE, result_of

from articulate_ssl.inference.articulation import posed_parts
from articulate_ssl.inference.export import coloured_clouds
from articulate_ssl.inference.export.prediction_json import describe
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.prediction import Prediction


def test_every_point_of_the_scan_is_coloured_by_its_part(tmp_path):
    prediction, points = synthetic.laptop()
    seen = points.numpy()[::4]
    prediction = Prediction(**{**vars(prediction), "part_id": prediction.part_id[:, ::4]})
    cloud = points.numpy() * SCALE + CENTER
    result = result_of(synthetic.laptop, prediction=prediction, points=seen, cloud=cloud)
    coloured_clouds.write(result, tmp_path)
    coloured = trimesh.load(tmp_path / "parts.ply")
    np.testing.assert_allclose(coloured.vertices, cloud, atol=1e-5)
    true_parts = synthetic.laptop()[0].part_id[0].numpy()
    assert (coloured.colors[:, :3] == part_colour(true_parts)).all(axis=1).mean() > 0.95
    assert sum(p["num_points"] for p in describe(result)["parts"]) == len(cloud)


@pytest.mark.parametrize("make", OBJECTS)
def test_the_reconstruction_is_the_posed_parts_each_in_its_colour(tmp_path, make):
    result = result_of(make)
    coloured_clouds.write(result, tmp_path)
    coloured = trimesh.load(tmp_path / "reconstruction.ply")
    expected = posed_parts(result.prediction)[0]
    np.testing.assert_allclose(coloured.vertices, expected.reshape(-1, 3), atol=1e-5)
    parts = np.repeat(np.arange(len(expected)), expected.shape[1])
    np.testing.assert_array_equal(coloured.colors[:, :3], part_colour(parts))
