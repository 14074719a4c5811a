import numpy as np
import pytest
import synthetic_predictions as synthetic

from articulate_ssl.inference.articulation import canonical_object
from articulate_ssl.inference.pictures.joint_arrow import joint_arrow


@pytest.mark.parametrize(("make", "joint"), [(synthetic.laptop, 0), (synthetic.drawer, 1), (synthetic.arm, 0)])
def test_the_arrow_lies_along_the_axis_and_is_longer_than_the_part(make, joint):
    prediction, _ = make()
    tail, middle, tip = joint_arrow(prediction, joint)
    axis = prediction.canonical_axis[0, joint].numpy()
    np.testing.assert_allclose((tip - tail) / np.linalg.norm(tip - tail), axis, atol=1e-6)
    np.testing.assert_allclose(middle, (tail + tip) / 2)
    part = canonical_object(prediction)[0, prediction.joint_child[0, joint]].numpy()
    assert np.linalg.norm(tip - tail) > np.ptp(part @ axis)


def test_the_arrow_of_a_hinge_is_on_the_hinge_and_that_of_a_drawer_on_the_drawer():
    laptop, _ = synthetic.laptop()
    middle = joint_arrow(laptop, 0)[1]
    np.testing.assert_allclose(np.cross(middle - laptop.canonical_pivot[0, 0].numpy(), (-1, 0, 0)), 0, atol=1e-6)
    drawer, _ = synthetic.drawer()
    part = canonical_object(drawer)[0, 1].numpy()
    np.testing.assert_allclose(joint_arrow(drawer, 0)[1], (part.min(axis=0) + part.max(axis=0)) / 2, atol=1e-6)
