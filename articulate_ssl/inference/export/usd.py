"""The predicted object as a USD stage with UsdPhysics joints, which Isaac Sim, Omniverse and Blender open.

It needs usd-core (the extra `usd`), which is imported when something is written.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from articulate_ssl.inference.export.linear_colour import linear_colour
from articulate_ssl.inference.export.rigid_links import RigidJoint, RigidLink, RigidObject, rigid_object
from articulate_ssl.inference.scan_prediction import ScanPrediction
from datamodules.atomic import atomic_write

if TYPE_CHECKING:
    from pxr import Gf, Usd, UsdGeom

# USD joints move along or about a coordinate axis of a frame of their own: we take x, and turn that frame.
JOINT_AXIS = "X"


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `object.usda`: the object where the scan shows it, as an articulation with a free base.

    Convention:
        That of `rigid_links`. The default prim `/<category>` is the articulation root and stands at the predicted base
        pose, in the frame of the scan; its children are the links, side by side as UsdPhysics demands, in the
        predicted states, and the joints, whose frames' x axes are the joint axes. Revolute limits are in degrees. Up
        is z and a unit is a metre, for want of knowing better.

    Returns:
        The file written.

    Raises:
        ModuleNotFoundError: if usd-core is not installed.
    """
    file = folder / "object.usda"
    with atomic_write(file) as opened:
        opened.write(_stage(rigid_object(result)).ExportToString(addSourceFileComment=False).encode())
    return [file]


def _stage(thing: RigidObject) -> Usd.Stage:
    from pxr import Tf, Usd, UsdGeom, UsdPhysics

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    top = UsdGeom.Xform.Define(stage, f"/{Tf.MakeValidIdentifier(thing.name)}")
    stage.SetDefaultPrim(top.GetPrim())
    UsdPhysics.ArticulationRootAPI.Apply(top.GetPrim())
    _place(top, thing.pose)
    for link, pose in zip(thing.links, thing.link_poses(), strict=True):
        _add_link(stage, str(top.GetPath()), link, pose)
    for joint in thing.joints:
        _add_joint(stage, str(top.GetPath()), thing, joint)
    return stage


def _add_link(
    stage: Usd.Stage,
    top: str,
    link: RigidLink,
    pose: np.ndarray,  # [4, 4] in the root link's frame
) -> None:
    from pxr import Gf, UsdGeom, UsdPhysics

    body = UsdGeom.Xform.Define(stage, f"{top}/{link.name}")
    _place(body, pose)
    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    mass = UsdPhysics.MassAPI.Apply(body.GetPrim())
    moments, axes = np.linalg.eigh(link.inertia)
    axes[:, 0] *= np.linalg.det(axes)
    mass.CreateMassAttr(link.mass)
    mass.CreateCenterOfMassAttr(_vector(link.center_of_mass))
    mass.CreateDiagonalInertiaAttr(_vector(moments))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(_quaternion(axes)))
    _add_mesh(stage, f"{top}/{link.name}/mesh", link)


def _add_mesh(stage: Usd.Stage, path: str, link: RigidLink) -> None:
    from pxr import Gf, UsdGeom, UsdPhysics, Vt

    mesh = UsdGeom.Mesh.Define(stage, path)
    points = np.ascontiguousarray(link.vertices, dtype=np.float32)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)])))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(link.mesh.faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(link.mesh.faces.astype(np.int32).reshape(-1)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDisplayColorAttr([Gf.Vec3f(*linear_colour(link.colour).tolist())])
    UsdPhysics.CollisionAPI.Apply(mesh.GetPrim())
    hull = UsdPhysics.MeshCollisionAPI.Apply(mesh.GetPrim())
    hull.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)


def _add_joint(stage: Usd.Stage, top: str, thing: RigidObject, joint: RigidJoint) -> None:
    from pxr import Gf, UsdPhysics

    revolute = joint.kind == "revolute"
    schema = UsdPhysics.RevoluteJoint if revolute else UsdPhysics.PrismaticJoint
    added = schema.Define(stage, f"{top}/{joint.name}")
    added.CreateBody0Rel().SetTargets([f"{top}/{thing.links[joint.parent].name}"])
    added.CreateBody1Rel().SetTargets([f"{top}/{thing.links[joint.child].name}"])
    turn = Gf.Quatf(_quaternion(_rotation_of_x_to(joint.axis)))
    added.CreateLocalPos0Attr(_vector(joint.origin))
    added.CreateLocalRot0Attr(turn)
    added.CreateLocalPos1Attr(_vector(np.zeros(3)))
    added.CreateLocalRot1Attr(turn)
    added.CreateAxisAttr(JOINT_AXIS)
    added.CreateLowerLimitAttr(math.degrees(joint.lower) if revolute else joint.lower)
    added.CreateUpperLimitAttr(math.degrees(joint.upper) if revolute else joint.upper)
    added.CreateCollisionEnabledAttr(False)


def _rotation_of_x_to(
    axis: np.ndarray,  # [3] unit
) -> np.ndarray:  # [3, 3]
    return Rotation.align_vectors(axis[None], np.array([[1.0, 0, 0]]))[0].as_matrix()


def _place(
    prim: UsdGeom.Xform,
    pose: np.ndarray,  # [4, 4]
) -> None:
    from pxr import Gf, UsdGeom

    prim.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*pose[:3, 3].tolist()))
    prim.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(_quaternion(pose[:3, :3]))


def _vector(values: np.ndarray) -> Gf.Vec3f:
    from pxr import Gf

    return Gf.Vec3f(*values.tolist())


def _quaternion(
    rotation: np.ndarray,  # [3, 3]
) -> Gf.Quatd:
    from pxr import Gf

    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return Gf.Quatd(w, x, y, z)
