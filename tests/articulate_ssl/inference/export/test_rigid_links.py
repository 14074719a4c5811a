"""What all formats share: closed meshes, masses and inertias, read back from every file."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
import trimesh
import yourdfpy
from joint_zoo import ZOO
from pxr import Usd, UsdGeom, UsdPhysics
from scan_predictions import result_of
from scipy.spatial.transform import Rotation

from articulate_ssl.inference.export import glb, mjcf, urdf, usd
from articulate_ssl.inference.export.linear_colour import linear_colour
from articulate_ssl.inference.export.rigid_links import DENSITY, MIN_PART, RigidLink, rigid_object
from articulate_ssl.inference.scan_prediction import ScanPrediction
from articulate_ssl.ops.farthest_point import farthest_point_order


def hollow_laptop() -> ScanPrediction:
    """A laptop whose base is a case with one open side: a mesh with a cavity."""
    outer, inner = trimesh.creation.box((0.6, 0.6, 0.6)), trimesh.creation.box((0.5, 0.6, 0.5))
    case = trimesh.boolean.difference([outer, inner.apply_translation((0, 0.1, 0))])
    points = np.asarray(trimesh.sample.sample_surface(case, 4096, seed=1)[0])
    points = points[farthest_point_order(points, 256)]
    return with_shape(result_of(ZOO[0], scale=1.0), 0, torch.from_numpy(points))


def with_shape(result: ScanPrediction, part: int, points: torch.Tensor) -> ScanPrediction:
    shape = result.prediction.part_shape.clone()
    shape[0, part] = points
    return replace(result, prediction=replace(result.prediction, part_shape=shape))


def usd_mesh(stage: Usd.Stage, part: int) -> trimesh.Trimesh:
    path = stage.GetDefaultPrim().GetPath().AppendPath(f"part_{part}/mesh")
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath(path))
    assert set(mesh.GetFaceVertexCountsAttr().Get()) == {3}
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    return trimesh.Trimesh(np.array(mesh.GetPointsAttr().Get()), faces)


@pytest.mark.parametrize(
    "result", [hollow_laptop(), result_of(ZOO[3]), result_of(ZOO[0], scale=300.0), result_of(ZOO[0], scale=1e-3)]
)
def test_every_mesh_that_is_read_back_encloses_a_volume(tmp_path, result):
    for write in (urdf.write, mjcf.write, glb.write, usd.write):
        write(result, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "object.usda"))
    scene = trimesh.load_scene(tmp_path / "object.glb")
    for k, link in enumerate(rigid_object(result).links):
        stl = trimesh.load_mesh(tmp_path / f"meshes/part_{k}.stl")
        for mesh in (stl, scene.geometry[scene.graph[f"part_{k}"][1]], usd_mesh(stage, k)):
            assert mesh.is_watertight and mesh.is_winding_consistent
            assert mesh.body_count == 1
            # Tolerances of trimesh suit sizes near one.
            grown = mesh.copy().apply_scale(1 / link.mesh.extents.max())
            assert grown.is_volume
            assert mesh.volume == pytest.approx(link.mesh.volume, rel=1e-3)


def test_masses_and_inertias_are_those_of_a_solid_of_the_stated_density(tmp_path):
    """A brick has its textbook inertia, and it is about the centre of mass, which is not the link's origin."""
    corners = torch.cartesian_prod(*(torch.tensor([-0.5, 0.5], dtype=torch.float64) * e for e in (0.3, 0.2, 0.1)))
    result = with_shape(result_of(ZOO[0], scale=1.0), 1, corners.repeat(32, 1))
    link = rigid_object(result).links[1]
    mass = DENSITY * 0.3 * 0.2 * 0.1
    assert link.mass == pytest.approx(mass, rel=1e-5)
    expected = mass / 12 * np.diag([0.2**2 + 0.1**2, 0.3**2 + 0.1**2, 0.3**2 + 0.2**2])
    np.testing.assert_allclose(link.inertia, expected, atol=1e-5 * mass)
    center = (result.prediction.assembly[0, 1] - result.prediction.canonical_pivot[0, 0]).numpy()
    np.testing.assert_allclose(link.center_of_mass, center, atol=1e-6)


@pytest.mark.parametrize("make", ZOO)
def test_every_format_states_the_same_masses_and_inertias(tmp_path, make):
    result = result_of(make, scale=2.0)
    for write in (urdf.write, mjcf.write, usd.write):
        write(result, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "object.usda"))
    robot = yourdfpy.URDF.load(str(tmp_path / "object.urdf"))
    models = [mujoco.MjModel.from_xml_path(str(tmp_path / name)) for name in ("object.urdf", "object.xml")]
    for k, link in enumerate(rigid_object(result).links):
        inertial = robot.link_map[link.name].inertial
        assert_same(link, inertial.mass, inertial.origin[:3, 3], inertial.inertia)
        for model in models:
            body = model.body(link.name)
            turn = Rotation.from_quat(body.iquat, scalar_first=True).as_matrix()
            assert_same(link, body.mass[0], body.ipos, turn @ np.diag(body.inertia) @ turn.T)
        mass = UsdPhysics.MassAPI(stage.GetPrimAtPath(stage.GetDefaultPrim().GetPath().AppendChild(f"part_{k}")))
        axes = mass.GetPrincipalAxesAttr().Get()
        turn = Rotation.from_quat([*axes.GetImaginary(), axes.GetReal()]).as_matrix()
        inertia = turn @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ turn.T
        assert_same(link, mass.GetMassAttr().Get(), mass.GetCenterOfMassAttr().Get(), inertia)


def assert_same(link: RigidLink, mass: float, center: np.ndarray, inertia: np.ndarray) -> None:
    assert mass == pytest.approx(link.mass, rel=1e-6)
    np.testing.assert_allclose(center, link.center_of_mass, atol=1e-6)
    np.testing.assert_allclose(inertia, link.inertia, atol=1e-5 * np.trace(link.inertia))


def test_masses_follow_the_unit():
    small, large = (rigid_object(result_of(ZOO[0], scale=scale)).links[1] for scale in (1e-4, 1.0))
    assert large.mass == pytest.approx(small.mass * 1e12, rel=1e-3)
    np.testing.assert_allclose(large.inertia, small.inertia * 1e20, atol=1e-3 * np.trace(large.inertia))


def test_a_part_of_coinciding_points_is_a_small_cube_that_simulators_accept(tmp_path):
    result = with_shape(result_of(ZOO[0], scale=1.0), 1, torch.zeros(256, 3, dtype=torch.float64))
    for write in (urdf.write, mjcf.write):
        write(result, tmp_path)
    extents = trimesh.load_mesh(tmp_path / "meshes/part_1.stl").extents
    np.testing.assert_allclose(extents, MIN_PART * 0.8, rtol=0.02)
    for name in ("object.urdf", "object.xml"):
        assert (mujoco.MjModel.from_xml_path(str(tmp_path / name)).body("part_1").inertia > 0).all()


def test_a_joint_that_never_moved_has_a_range_that_simulators_accept(tmp_path):
    state = result_of(ZOO[0]).prediction.joint_state[0]
    result = replace(result_of(ZOO[0]), limits=state[:, None].repeat(1, 2))
    mjcf.write(result, tmp_path)
    lower, upper = mujoco.MjModel.from_xml_path(str(tmp_path / "object.xml")).jnt_range[0]
    assert lower < state[0] < upper < lower + 1e-3


def test_an_object_of_one_part_is_written_in_every_format(tmp_path):
    result = result_of(ZOO[0])
    single = {"part_pose": slice(1), "part_shape": slice(1), "assembly": slice(1)}
    single |= dict.fromkeys((n for n in vars(result.prediction) if "joint" in n or "canonical" in n), slice(0))
    fields = {name: getattr(result.prediction, name)[:, part] for name, part in single.items()}
    alone = replace(result, prediction=replace(result.prediction, **fields), limits=torch.zeros(0, 2))
    for write in (urdf.write, mjcf.write, glb.write, usd.write):
        write(alone, tmp_path)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "object.xml")).nbody == 2
    assert len(trimesh.load_scene(tmp_path / "object.glb").geometry) == 1
    assert Usd.Stage.Open(str(tmp_path / "object.usda")).GetDefaultPrim().GetChildrenNames() == ["part_0"]


def test_a_name_that_usd_does_not_allow_is_changed(tmp_path):
    usd.write(replace(result_of(ZOO[0]), category="my box-2"), tmp_path)
    assert Usd.Stage.Open(str(tmp_path / "object.usda")).GetDefaultPrim().GetName() == "my_box_2"


def test_an_upright_camera_tells_where_gravity_points(tmp_path):
    for upright, expected in [(True, (0, 9.81, 0)), (False, (0, 0, -9.81))]:
        mjcf.write(replace(result_of(ZOO[0]), upright=upright), tmp_path)
        gravity = mujoco.MjModel.from_xml_path(str(tmp_path / "object.xml")).opt.gravity
        np.testing.assert_allclose(gravity, expected)


def test_the_usd_stage_is_an_articulation_of_rigid_bodies(tmp_path):
    usd.write(result_of(ZOO[3]), tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "object.usda"))
    top = stage.GetDefaultPrim()
    assert top.HasAPI(UsdPhysics.ArticulationRootAPI)
    bodies = [prim for prim in stage.Traverse() if prim.HasAPI(UsdPhysics.RigidBodyAPI)]
    assert [body.GetParent() for body in bodies] == [top] * 4  # nested bodies would not move on their own
    assert all(body.GetChild("mesh").HasAPI(UsdPhysics.CollisionAPI) for body in bodies)
    # The pose in the file agrees with the joint's frames, as UsdPhysics demands: both name one place.
    cache = UsdGeom.XformCache()
    for prim in stage.Traverse():
        if prim.IsA(UsdPhysics.RevoluteJoint):
            joint = UsdPhysics.Joint(prim)
            places = []
            for body, position in (
                (joint.GetBody0Rel(), joint.GetLocalPos0Attr()),
                (joint.GetBody1Rel(), joint.GetLocalPos1Attr()),
            ):
                pose = cache.GetLocalToWorldTransform(stage.GetPrimAtPath(body.GetTargets()[0]))
                places.append(pose.Transform(position.Get()))
            np.testing.assert_allclose(*places, atol=1e-5)


def test_colours_are_stated_in_linear_light():
    np.testing.assert_allclose(linear_colour(np.array([0.0, 0.04, 0.5, 1.0])), [0, 0.04 / 12.92, 0.21404, 1], atol=1e-5)
