"""The predicted object as an animated GLB (binary glTF 2.0), which browsers, Blender and slides play."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pygltflib
from pygltflib import GLTF2
from scipy.spatial.transform import Rotation

from articulate_ssl.inference.export.linear_colour import linear_colour
from articulate_ssl.inference.export.rigid_links import RigidJoint, RigidLink, RigidObject, rigid_object
from articulate_ssl.inference.scan_prediction import ScanPrediction
from datamodules.atomic import atomic_write

# From x right, y down, z forward to x right, y up, z backward.
CAMERA_TO_GLTF = np.diag([1.0, -1.0, -1.0, 1.0])
# For a person to follow; chosen without a measurement.
SECONDS_PER_SWEEP = 1.5
# Readers turn the short way from one key to the next, so keys lie well below half a turn apart.
KEYS_PER_SWEEP = 13


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `object.glb`: the object where the scan shows it, and an animation that moves its joints one by one.

    Convention:
        That of `rigid_links`; a node is a link, nested in its parent, with its mesh in its own frame. The top node is
        `scan`, whose child, of the category's name, holds the root link at the predicted base pose, in the frame and
        the unit of the scan. Where an upright camera took it, `scan` turns its axes to glTF's (y up, z to the viewer);
        else it does nothing. Still, the object is in the predicted states. In the animation `joints` each joint in
        turn goes from there to its upper limit, to its lower one, and back.

    Returns:
        The file written.
    """
    thing = rigid_object(result)
    document = _Document()
    for k, link in enumerate(thing.links):
        document.add_mesh(link)
        document.gltf.nodes.append(pygltflib.Node(name=link.name, mesh=k, children=_children(thing, k)))
    for joint in thing.joints:
        _place(document.gltf.nodes[joint.child], joint.motion(joint.state))
    document.add_top_nodes(thing)
    if thing.joints:
        document.gltf.animations.append(_animation(document, thing))
    file = folder / "object.glb"
    with atomic_write(file) as opened:
        opened.write(document.to_bytes())
    return [file]


class _Document:
    """A glTF document that grows: every array that is added gets an accessor."""

    def __init__(self) -> None:
        self.gltf = GLTF2(asset=pygltflib.Asset(generator="articulate-ssl"))
        self._binary = bytearray()

    def add_array(
        self,
        values: np.ndarray,  # [N] or [N, C]
        kind: str,
        target: int | None = None,
    ) -> int:
        """The number of the new accessor, of 32-bit numbers; `kind` and `target` are glTF's."""
        whole = values.dtype.kind in "iu"
        values = np.ascontiguousarray(values, dtype="<u4" if whole else "<f4")
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self._binary), byteLength=values.nbytes, target=target)
        columns = values.reshape(len(values), -1)
        self.gltf.bufferViews.append(view)
        self.gltf.accessors.append(
            pygltflib.Accessor(
                bufferView=len(self.gltf.bufferViews) - 1,
                componentType=pygltflib.UNSIGNED_INT if whole else pygltflib.FLOAT,
                count=len(values),
                type=kind,
                min=columns.min(axis=0).tolist(),
                max=columns.max(axis=0).tolist(),
            )
        )
        self._binary += values.tobytes()
        return len(self.gltf.accessors) - 1

    def add_mesh(self, link: RigidLink) -> None:
        """The link's mesh, flat shaded (readers do that where normals are missing), with a material of its colour."""
        position = self.add_array(link.vertices, pygltflib.VEC3, pygltflib.ARRAY_BUFFER)
        faces = link.mesh.faces.reshape(-1)
        surface = pygltflib.Primitive(
            attributes=pygltflib.Attributes(POSITION=position),
            indices=self.add_array(faces, pygltflib.SCALAR, pygltflib.ELEMENT_ARRAY_BUFFER),
            material=len(self.gltf.materials),
        )
        colour = [*linear_colour(link.colour).tolist(), 1.0]
        plastic = pygltflib.PbrMetallicRoughness(baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=0.8)
        self.gltf.materials.append(pygltflib.Material(name=link.name, pbrMetallicRoughness=plastic, alphaCutoff=None))
        self.gltf.meshes.append(pygltflib.Mesh(name=link.name, primitives=[surface]))

    def add_top_nodes(self, thing: RigidObject) -> None:
        """`scan` and the category's node above the root link's, and the scene."""
        base = pygltflib.Node(name=thing.name, children=[thing.root])
        _place(base, thing.pose)
        scan = pygltflib.Node(name="scan", children=[len(self.gltf.nodes)])
        if thing.upright:
            _place(scan, CAMERA_TO_GLTF)
        self.gltf.nodes += [base, scan]
        self.gltf.scenes.append(pygltflib.Scene(name=thing.name, nodes=[len(self.gltf.nodes) - 1]))
        self.gltf.scene = 0

    def to_bytes(self) -> bytes:
        self.gltf.buffers.append(pygltflib.Buffer(byteLength=len(self._binary)))
        self.gltf.set_binary_blob(bytes(self._binary))
        return b"".join(self.gltf.save_to_bytes())


def _children(thing: RigidObject, link: int) -> list[int]:
    return [joint.child for joint in thing.joints_of(link)]


def _place(
    node: pygltflib.Node,
    pose: np.ndarray,  # [4, 4]
) -> None:
    node.translation = pose[:3, 3].tolist()
    node.rotation = Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()


def _animation(document: _Document, thing: RigidObject) -> pygltflib.Animation:
    animation = pygltflib.Animation(name="joints")
    for turn, joint in enumerate(thing.joints):
        time, states = _sweep(joint)
        # Keys at both ends of the whole animation hold a joint still while others move.
        end = 3 * SECONDS_PER_SWEEP * len(thing.joints)
        time = np.concatenate([[0.0], time + 3 * SECONDS_PER_SWEEP * turn, [end]])
        states = np.concatenate([[joint.state], states, [joint.state]])
        time, first = np.unique(time, return_index=True)
        poses = np.stack([joint.motion(state) for state in states[first].tolist()])
        _animate(document, animation, joint, time, poses)
    return animation


def _sweep(joint: RigidJoint) -> tuple[np.ndarray, np.ndarray]:
    """Times [T] from zero to three sweeps, and states [T]: up, down, back."""
    stops = [joint.state, joint.upper, joint.lower, joint.state]
    time = np.linspace(0, 3 * SECONDS_PER_SWEEP, 3 * (KEYS_PER_SWEEP - 1) + 1)
    return time, np.interp(time, SECONDS_PER_SWEEP * np.arange(4), stops)


def _animate(
    document: _Document,
    animation: pygltflib.Animation,
    joint: RigidJoint,
    time: np.ndarray,  # [T] seconds
    poses: np.ndarray,  # [T, 4, 4] of the child in its parent
) -> None:
    if joint.kind == "revolute":
        path, kind, values = "rotation", pygltflib.VEC4, Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    else:
        path, kind, values = "translation", pygltflib.VEC3, poses[:, :3, 3]
    sampler = pygltflib.AnimationSampler(
        input=document.add_array(time, pygltflib.SCALAR),
        output=document.add_array(values, kind),
        interpolation=pygltflib.ANIM_LINEAR,
    )
    target = pygltflib.AnimationChannelTarget(node=joint.child, path=path)
    animation.channels.append(pygltflib.AnimationChannel(sampler=len(animation.samplers), target=target))
    animation.samplers.append(sampler)
