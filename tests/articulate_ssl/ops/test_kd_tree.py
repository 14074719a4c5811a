"""A tree of points that survives flushed denormals."""

import subprocess
import sys

import numpy as np
from scipy.spatial import cKDTree

from articulate_ssl.ops.kd_tree import kd_tree


def test_faces_in_coordinate_planes_do_not_crash_it_while_denormals_are_flushed():
    program = """if True:
        import numpy as np, torch
        from articulate_ssl.ops.kd_tree import kd_tree
        torch.set_flush_denormal(True)
        points = np.random.default_rng(0).random((1000, 3))
        points[:700, 2] = 0
        assert (kd_tree(points).query(points)[0] == 0).all()
    """
    assert subprocess.run([sys.executable, "-c", program]).returncode == 0


def test_neighbours_are_those_of_scipys_own_tree():
    rng = np.random.default_rng(0)
    points, query = rng.random((500, 3)), rng.random((200, 3))
    for ours, theirs in zip(kd_tree(points).query(query, k=3), cKDTree(points).query(query, k=3), strict=True):
        np.testing.assert_array_equal(ours, theirs)
