import numpy as np
import synthetic_predictions as synthetic
from scan_predictions import CENTER, SCALE, result_of

from articulate_ssl.inference.export import picture


def test_a_dense_scan_is_thinned_for_the_picture(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(picture, "draw_prediction", lambda *arguments: drawn.append(arguments))
    cloud = np.repeat(synthetic.laptop()[1].numpy() * SCALE + CENTER, 20, axis=0)
    result = result_of(synthetic.laptop, cloud=cloud)
    assert picture.write(result, tmp_path) == [tmp_path / "picture.png"]
    ((_, points, part_id, *_),) = drawn
    assert len(cloud) > len(points) == len(part_id) == picture.MAX_DRAWN_POINTS
    assert {tuple(p) for p in points} <= {tuple(p) for p in cloud}
