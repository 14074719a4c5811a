"""Every exported file, read by somebody else's library, moves as the prediction articulates."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pygltflib
import pytest
import torch
import trimesh
import yourdfpy
from joint_zoo import ZOO
from pxr import Gf, Usd, UsdGeom, UsdPhysics
from scan_predictions import keep_solid, result_of
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation, Slerp

from articulate_ssl.inference.articulation import articulate
from articulate_ssl.inference.export import glb, mjcf, rigid_links, urdf, usd
from articulate_ssl.inference.scan_prediction import ScanPrediction

# Files hold float32 numbers of coordinates up to 10 (the scans lie away from the origin).
TOLERANCE = 1e-5
STATES = 5


@pytest.fixture(autouse=True)
def solid(monkeypatch):
    keep_solid(monkeypatch)


def states_of(result: ScanPrediction) -> np.ndarray:  # [STATES, J]
    """The predicted states, and others of either sign."""
    predicted = result.prediction.joint_state.numpy()
    other = np.random.default_rng(0).uniform(-1, 1, (STATES - 1, predicted.shape[1]))
    return np.concatenate([predicted, other])


def miss(result: ScanPrediction, states: np.ndarray, vertices: list[np.ndarray]) -> float:
    """How far mesh vertices (of every part, in the scan's frame) are from the articulated part's points, at most.

    Meshes have vertices only where the part has points; these are scattered, so that no other pose fits them.
    """
    points = articulate(result.prediction, torch.from_numpy(states))[0].numpy()
    assert len(vertices) == len(points) and min(map(len, vertices)) > 20
    return max(float(cKDTree(p).query(v)[0].max()) for p, v in zip(points, vertices, strict=True))


def moved(vertices: np.ndarray, pose: np.ndarray) -> np.ndarray:
    return vertices @ pose[:3, :3].T + pose[:3, 3]


def read_urdf_by_yourdfpy(result: ScanPrediction, folder: Path, states: np.ndarray) -> list[np.ndarray]:
    robot = yourdfpy.URDF.load(str(folder / "object.urdf"))
    robot.update_cfg({f"joint_{j}": state for j, state in enumerate(states)})
    found = []
    for k in range(result.prediction.num_parts):
        (visual,) = robot.link_map[f"part_{k}"].visuals
        mesh = trimesh.load_mesh(folder / visual.geometry.mesh.filename)
        pose = result.prediction.base_pose[0].numpy() @ robot.get_transform(f"part_{k}") @ visual.origin
        found.append(moved(mesh.vertices, pose))
    return found


def read_by_mujoco(result: ScanPrediction, file: Path, states: np.ndarray) -> list[np.ndarray]:
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    for j, state in enumerate(states):
        data.joint(f"joint_{j}").qpos = state
    mujoco.mj_forward(model, data)
    found = []
    for k in range(result.prediction.num_parts):
        (geom,) = np.flatnonzero(model.geom_bodyid == model.body(f"part_{k}").id)
        mesh = model.mesh(model.geom_dataid[geom])
        vertices = model.mesh_vert[mesh.vertadr[0] : mesh.vertadr[0] + mesh.vertnum[0]]
        found.append(vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom])
    return found


def read_urdf_by_mujoco(result: ScanPrediction, folder: Path, states: np.ndarray) -> list[np.ndarray]:
    base = result.prediction.base_pose[0].numpy()
    return [moved(vertices, base) for vertices in read_by_mujoco(result, folder / "object.urdf", states)]


def read_mjcf(result: ScanPrediction, folder: Path, states: np.ndarray) -> list[np.ndarray]:
    return read_by_mujoco(result, folder / "object.xml", states)


def read_usd(result: ScanPrediction, folder: Path, states: np.ndarray) -> list[np.ndarray]:
    """What UsdPhysics says of its joints: body1 = body0 * frame0 * motion along the token's axis * frame1^-1."""
    stage = Usd.Stage.Open(str(folder / "object.usda"))
    top = stage.GetDefaultPrim()
    poses = {top.GetPath().AppendChild(f"part_{root_of(result)}"): np.eye(4)}
    waiting = {top.GetPath().AppendChild(f"joint_{j}"): state for j, state in enumerate(states)}
    while waiting:
        for path in list(waiting):
            joint = UsdPhysics.Joint(stage.GetPrimAtPath(path))
            (parent,), (child,) = joint.GetBody0Rel().GetTargets(), joint.GetBody1Rel().GetTargets()
            if parent in poses:
                frame0 = frame_of(joint.GetLocalPos0Attr().Get(), joint.GetLocalRot0Attr().Get())
                frame1 = frame_of(joint.GetLocalPos1Attr().Get(), joint.GetLocalRot1Attr().Get())
                motion = usd_motion(stage.GetPrimAtPath(path), waiting.pop(path))
                poses[child] = poses[parent] @ frame0 @ motion @ np.linalg.inv(frame1)
    world = np.array(UsdGeom.Xformable(top).GetLocalTransformation()).T
    return [
        moved(usd_points(stage, path), world @ pose)
        for path, pose in sorted(poses.items(), key=lambda item: item[0].name)
    ]


def root_of(result: ScanPrediction) -> int:
    (root,) = set(range(result.prediction.num_parts)) - set(result.prediction.joint_child[0].tolist())
    return root


def frame_of(position: Gf.Vec3f, rotation: Gf.Quatf) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([*rotation.GetImaginary(), rotation.GetReal()]).as_matrix()
    pose[:3, 3] = position
    return pose


def usd_motion(prim: Usd.Prim, state: float) -> np.ndarray:
    axis = np.eye(3)["XYZ".index(prim.GetAttribute("physics:axis").Get())]
    pose = np.eye(4)
    if prim.IsA(UsdPhysics.RevoluteJoint):
        pose[:3, :3] = Rotation.from_rotvec(axis * state).as_matrix()
    else:
        assert prim.IsA(UsdPhysics.PrismaticJoint)
        pose[:3, 3] = axis * state
    return pose


def usd_points(stage: Usd.Stage, part) -> np.ndarray:
    return np.array(UsdGeom.Mesh(stage.GetPrimAtPath(part.AppendChild("mesh"))).GetPointsAttr().Get())


READERS = {
    "URDF by yourdfpy": (urdf.write, read_urdf_by_yourdfpy),
    "URDF by mujoco": (urdf.write, read_urdf_by_mujoco),
    "MJCF by mujoco": (mjcf.write, read_mjcf),
    "USD by usd-core": (usd.write, read_usd),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("make", ZOO)
def test_any_state_puts_the_meshes_where_the_prediction_articulates(tmp_path, make, reader):
    (write, read), result = READERS[reader], result_of(make)
    write(result, tmp_path)
    for states in states_of(result):
        assert miss(result, states, read(result, tmp_path, states)) < TOLERANCE


@pytest.mark.parametrize("reader", ["MJCF by mujoco", "USD by usd-core"])
def test_an_object_in_metres_of_a_map_is_where_it_was_scanned(tmp_path, reader):
    (write, read), result = READERS[reader], result_of(ZOO[0], center=np.array([500000.123456, 5400000.654321, 300]))
    write(result, tmp_path)
    states = result.prediction.joint_state[0].numpy()
    assert miss(result, states, read(result, tmp_path, states)) < TOLERANCE


@pytest.mark.parametrize("make", ZOO)
def test_the_parts_of_a_usd_stage_stand_in_the_predicted_state(tmp_path, make):
    result = result_of(make)
    usd.write(result, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "object.usda"))
    cache, vertices = UsdGeom.XformCache(), []
    for k in range(result.prediction.num_parts):
        part = stage.GetDefaultPrim().GetPath().AppendChild(f"part_{k}")
        pose = np.array(cache.GetLocalToWorldTransform(stage.GetPrimAtPath(part))).T
        vertices.append(moved(usd_points(stage, part), pose))
    assert miss(result, result.prediction.joint_state[0].numpy(), vertices) < TOLERANCE


def test_the_key_frame_of_an_mjcf_is_the_predicted_state(tmp_path):
    for make in ZOO:
        result = result_of(make)
        mjcf.write(result, tmp_path)
        model = mujoco.MjModel.from_xml_path(str(tmp_path / "object.xml"))
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, model.key("scan").id)
        found = [float(data.joint(f"joint_{j}").qpos[0]) for j in range(model.njnt)]
        np.testing.assert_allclose(found, result.prediction.joint_state[0], rtol=1e-6)


def glb_vertices(result: ScanPrediction, folder: Path, at: dict[str, np.ndarray] | None = None) -> list[np.ndarray]:
    """Vertices of the scene as trimesh reads it; `at` replaces the poses of nodes in their parents."""
    scene = trimesh.load_scene(folder / "object.glb")
    parents = {edge[1]: edge[0] for edge in scene.graph.to_edgelist()}
    for node, pose in (at or {}).items():
        scene.graph.update(frame_from=parents[node], frame_to=node, matrix=pose)
    found = []
    for k in range(result.prediction.num_parts):
        pose, geometry = scene.graph[f"part_{k}"]
        found.append(moved(scene.geometry[geometry].vertices, pose))
    return found


def array_of(document: pygltflib.GLTF2, accessor: int) -> np.ndarray:
    entry = document.accessors[accessor]
    view = document.bufferViews[entry.bufferView]
    assert entry.componentType == pygltflib.FLOAT
    columns = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[entry.type]
    return np.frombuffer(document.binary_blob(), "<f4", entry.count * columns, view.byteOffset).reshape(-1, columns)


def nodes_at(document: pygltflib.GLTF2, time: float) -> dict[str, np.ndarray]:
    """Poses of the nodes that the animation moves, as glTF interpolates them: slerp for rotations, else linearly."""
    (animation,) = document.animations
    poses = {}
    for channel in animation.channels:
        node, sampler = document.nodes[channel.target.node], animation.samplers[channel.sampler]
        assert sampler.interpolation == "LINEAR"
        times = array_of(document, sampler.input)[:, 0].astype(float)
        values = array_of(document, sampler.output).astype(float)
        placed = poses.setdefault(node.name, frame_of(node.translation, Gf.Quatf(1)))
        if channel.target.path == "rotation":
            placed[:3, :3] = Slerp(times, Rotation.from_quat(values))(time).as_matrix()
        else:
            assert channel.target.path == "translation"
            placed[:3, 3] = [np.interp(time, times, column) for column in values.T]
            placed[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
    return poses


def sweep_of(result: ScanPrediction, joint: int) -> list[tuple[float, np.ndarray]]:
    """Five times of the animation within a joint's turn and the states there: up, down, back."""
    lower, upper = result.limits[joint].tolist()
    predicted = result.prediction.joint_state[0].numpy()
    state = predicted[joint]
    lower, upper = min(lower, state), max(upper, state)
    stops = [(0, state), (0.4, 0.6 * state + 0.4 * upper), (1, upper), (1.55, 0.45 * upper + 0.55 * lower), (2, lower)]
    frames = []
    for sweeps, there in stops:
        states = predicted.copy()
        states[joint] = there
        frames.append(((3 * joint + sweeps) * glb.SECONDS_PER_SWEEP, states))
    return frames


@pytest.mark.parametrize("make", ZOO)
def test_a_glb_shows_the_predicted_state_and_its_animation_moves_each_joint_over_its_range(tmp_path, make):
    result = result_of(make)
    glb.write(result, tmp_path)
    predicted = result.prediction.joint_state[0].numpy()
    assert miss(result, predicted, glb_vertices(result, tmp_path)) < TOLERANCE
    document = pygltflib.GLTF2().load(tmp_path / "object.glb")
    frames = [frame for j in range(len(predicted)) for frame in sweep_of(result, j)]
    frames.append((3 * len(predicted) * glb.SECONDS_PER_SWEEP, predicted))
    for time, states in frames:
        vertices = glb_vertices(result, tmp_path, nodes_at(document, time))
        assert miss(result, states, vertices) < TOLERANCE, (time, states)


def test_a_full_turn_in_a_glb_is_not_shortened(tmp_path):
    result = replace(result_of(ZOO[0]), limits=torch.tensor([[-3.0, 3.2]]))
    glb.write(result, tmp_path)
    document = pygltflib.GLTF2().load(tmp_path / "object.glb")
    for time, states in sweep_of(result, 0):
        assert miss(result, states, glb_vertices(result, tmp_path, nodes_at(document, time))) < TOLERANCE


def test_a_scan_of_an_upright_camera_stands_upright_in_a_glb(tmp_path):
    result = replace(result_of(ZOO[0]), upright=True)
    glb.write(result, tmp_path)
    turned = [vertices * [1, -1, -1] for vertices in glb_vertices(result, tmp_path)]
    assert miss(result, result.prediction.joint_state[0].numpy(), turned) < TOLERANCE


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("make", ZOO)
def test_a_flipped_axis_would_be_noticed(tmp_path, monkeypatch, make, reader):
    """The comparison above can fail: with any one axis turned round, states move the parts the wrong way."""
    (write, read), result = READERS[reader], result_of(make)
    right = rigid_links.rigid_object(result)
    for wrong in range(len(right.joints)):
        joints = [replace(joint, axis=-joint.axis) if j == wrong else joint for j, joint in enumerate(right.joints)]
        for module in (urdf, mjcf, usd):
            monkeypatch.setattr(module, "rigid_object", lambda _, joints=joints: replace(right, joints=tuple(joints)))
        write(result, tmp_path)
        states = states_of(result)[1]
        assert miss(result, states, read(result, tmp_path, states)) > 100 * TOLERANCE


@pytest.mark.parametrize("make", ZOO)
def test_a_flipped_axis_in_a_glb_would_be_noticed(tmp_path, monkeypatch, make):
    result = result_of(make)
    right = rigid_links.rigid_object(result)
    for wrong in range(len(right.joints)):
        joints = [replace(joint, axis=-joint.axis) if j == wrong else joint for j, joint in enumerate(right.joints)]
        monkeypatch.setattr(glb, "rigid_object", lambda _, joints=joints: replace(right, joints=tuple(joints)))
        glb.write(result, tmp_path)
        time, states = sweep_of(result, wrong)[4]
        vertices = glb_vertices(result, tmp_path, nodes_at(pygltflib.GLTF2().load(tmp_path / "object.glb"), time))
        assert miss(result, states, vertices) > 100 * TOLERANCE


@pytest.mark.parametrize("make", ZOO)
def test_limits_keep_their_signs_in_every_format(tmp_path, make):
    result = result_of(make)
    predicted = result.prediction.joint_state[0, :, None]
    expected = torch.cat([result.limits, predicted], dim=1).aminmax(dim=1)
    expected = torch.stack([expected.min, expected.max], dim=1).numpy()
    for write in (urdf.write, mjcf.write, usd.write):
        write(result, tmp_path)
    stage = Usd.Stage.Open(str(tmp_path / "object.usda"))
    models = [mujoco.MjModel.from_xml_path(str(tmp_path / name)) for name in ("object.urdf", "object.xml")]
    robot = yourdfpy.URDF.load(str(tmp_path / "object.urdf"))
    for j, limits in enumerate(expected):
        prim = stage.GetPrimAtPath(stage.GetDefaultPrim().GetPath().AppendChild(f"joint_{j}"))
        found = [prim.GetAttribute(f"physics:{end}Limit").Get() for end in ("lower", "upper")]
        found = np.radians(found) if prim.IsA(UsdPhysics.RevoluteJoint) else found
        np.testing.assert_allclose(found, limits, rtol=1e-6)
        for model in models:
            assert model.joint(f"joint_{j}").limited
            np.testing.assert_allclose(model.joint(f"joint_{j}").range, limits, rtol=1e-6)
        limit = robot.joint_map[f"joint_{j}"].limit
        np.testing.assert_allclose([limit.lower, limit.upper], limits, rtol=1e-6)
