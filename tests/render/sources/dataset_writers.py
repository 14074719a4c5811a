"""Writes small objects in the exact on-disk formats of the data sets, with all their oddities.

The objects are stated in the canonical frame (y up, z front): a cabinet, whose door is hinged at its left front edge
and carries a knob, and a laptop stored with its lid upright.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh

IDENTITY = np.eye(3)
TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # canonical to HOI4D's and URDF's z up, front to -y


def box(low, high) -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[low, high])


CABINET = box([-0.5, 0, -0.4], [0.5, 1, 0.4])
DOOR = box([-0.5, 0, 0.4], [0.5, 1, 0.45])
KNOB = box([0.3, 0.45, 0.45], [0.4, 0.55, 0.5])
HINGE = np.array([-0.5, 0.2, 0.4])  # the door opens about -y
KNOB_CENTRE = np.array([0.35, 0.5, 0.45])

LAPTOP_BASE = box([-0.5, 0, -0.35], [0.5, 0.05, 0.35])
LID = box([-0.5, 0.05, -0.35], [0.5, 0.72, -0.3])  # upright: 90 degrees open, and closed after a quarter turn about x
LID_HINGE = np.array([0.1, 0.05, -0.35])


def write_obj(file: Path, mesh: trimesh.Trimesh, rotation: np.ndarray = IDENTITY) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in (mesh.vertices @ rotation.T).tolist()]
    lines += [f"f {i} {j} {k}" for i, j, k in (mesh.faces + 1).tolist()]
    file.write_text("\n".join(lines) + "\n")


def write_urdf(file: Path, body: str) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(f'<?xml version="1.0"?>\n<robot name="test">\n{body}\n</robot>\n')
    return file


def urdf_link(name: str, size: str = "1 1 1") -> str:
    return f'<link name="{name}"><visual><geometry><box size="{size}"/></geometry></visual></link>'


def urdf_joint(name: str, parent: str, child: str, kind: str = "revolute", **parts: str) -> str:
    axis = parts.get("axis", '<axis xyz="0 0 1"/>')
    limit = parts.get("limit", '<limit lower="0" upper="1"/>')
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{axis}{limit}{parts.get('extra', '')}</joint>"
    )


def _vector(values) -> str:
    return " ".join(repr(float(v)) for v in values)


def write_partnet(folder: Path, category: str, links: list[dict]) -> Path:
    """An object as SAPIEN publishes it: z up by a fixed joint below `base`, limits without effort and velocity.

    Every link is a dict with `mesh`, `label`, `semantic`, and for movable ones `parent` (link number), `type`, `axis`,
    `origin`, `limits`.
    """
    body = ['<link name="base"/>']
    semantics = []
    for k, link in enumerate(links):
        origin = np.asarray(link.get("origin", (0, 0, 0)), dtype=float)
        write_obj(folder / f"textured_objs/original-{k}.obj", link["mesh"])
        geometry = f'<geometry><mesh filename="textured_objs/original-{k}.obj"/></geometry>'
        shape = f'<origin xyz="{_vector(-origin)}"/>{geometry}'
        # Visual names repeat in the real files.
        body.append(f'<link name="link_{k}"><visual name="part">{shape}</visual><collision>{shape}</collision></link>')
        if "type" in link:
            parent_origin = np.asarray(links[link["parent"]].get("origin", (0, 0, 0)), dtype=float)
            limit = '<limit lower="{!r}" upper="{!r}"/>'.format(*link["limits"]) if "limits" in link else ""
            body.append(
                f'<joint name="joint_{k}" type="{link["type"]}"><origin xyz="{_vector(origin - parent_origin)}"/>'
                f'<axis xyz="{_vector(link["axis"])}"/><parent link="link_{link["parent"]}"/><child link="link_{k}"/>'
                f"{limit}</joint>"
            )
        else:
            body.append(
                f'<joint name="joint_{k}" type="fixed"><origin rpy="1.570796326794897 0 -1.570796326794897" '
                f'xyz="0 0 0"/><child link="link_{k}"/><parent link="base"/></joint>'
            )
        semantics.append(f"link_{k} {link['semantic']} {link['label']}")
    write_urdf(folder / "mobility.urdf", "\n".join(body))
    (folder / "semantics.txt").write_text("\n".join(semantics) + "\n")
    (folder / "meta.json").write_text(json.dumps({"model_id": "x", "anno_id": folder.name, "model_cat": category}))
    return folder


def partnet_safe(folder: Path, **door) -> Path:
    door = {"type": "revolute", "axis": (0, -0.1, 0), "limits": (0.0, 1.8), **door}
    return write_partnet(
        folder,
        "Safe",
        [
            {"mesh": CABINET, "semantic": "heavy", "label": "safe_body"},
            {"mesh": DOOR, "semantic": "hinge", "label": "door", "parent": 0, "origin": HINGE, **door},
            {
                "mesh": KNOB, "semantic": "hinge", "label": "knob", "parent": 1, "origin": KNOB_CENTRE,
                "type": "continuous", "axis": (0, 0, 1),
            },
        ],
    )  # fmt: skip


def write_mobility_v2(folder: Path, nodes: list[dict], meshes: dict[int, list[trimesh.Trimesh]], rotation) -> Path:
    """A HOI4D CAD model: `mobility_v2.json`, `result.json` and `objs`, with aligned copies that must not be read.

    Args:
        folder: Of the instance.
        nodes: Of `mobility_v2.json`; their `parts` hold ids.
        meshes: Leaf meshes by part id.
        rotation: From the canonical frame to the file's.
    """
    leaves, stem = [], 0
    for part, pieces in meshes.items():
        objs = []
        for piece in pieces:
            write_obj(folder / f"objs/new-{stem}.obj", piece, rotation)
            for suffix in ("-align", "_align"):
                aligned = piece.copy().apply_translation([5, 5, 5])
                write_obj(folder / f"objs/new-{stem}{suffix}.obj", aligned)
            objs.append(f"new-{stem}")
            stem += 1
        leaves.append({"id": part, "name": f"part {part}", "text": "", "objs": objs})
    tree = [{"id": 0, "name": "object", "text": "", "children": [{"id": 1, "name": "all", "children": leaves}]}]
    (folder / "result.json").write_text(json.dumps(tree))
    content = [{**n, "parts": [{"id": p, "name": n["name"], "children": []} for p in n["parts"]]} for n in nodes]
    (folder / "mobility_v2.json").write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")
    return folder


def hinge_data(origin, direction, a: float, b: float, no_limit: bool = False) -> dict:
    axis = {"origin": np.asarray(origin).tolist(), "direction": np.asarray(direction).tolist()}
    return {"axis": axis, "limit": {"a": a, "b": b, "noLimit": no_limit}}


def hoi4d_safe(folder: Path, rotation: np.ndarray = TO_Z_UP, limits=(0, -104.76), no_limit: bool = False) -> Path:
    """Like the real Safe 003: Chinese joint names, limits a > b in degrees, and a junk node that shifts the numbers."""
    data = hinge_data(rotation @ HINGE, rotation @ [0, 1, 0], *limits, no_limit)
    nodes = [
        {"id": 0, "parent": -1, "joint": "自由", "name": "frame", "parts": [2], "jointData": {}},
        {"id": 1, "parent": 0, "joint": "junk", "name": "junk", "parts": [6], "jointData": {}},
        {"id": 2, "parent": 0, "joint": "铰链（旋转）", "name": "door_frame", "parts": [4], "jointData": data},
        {"id": 3, "parent": 2, "joint": "静态", "name": "knob", "parts": [5], "jointData": {}},
    ]
    far = box([9, 9, 9], [10, 10, 10])
    return write_mobility_v2(folder, nodes, {2: [CABINET], 4: [DOOR], 5: [KNOB], 6: [far]}, rotation)


def motion_node(name: str, motion: str, center=(0, 0, 0), direction=(1, 0, 0), children=()) -> dict:
    return {
        "dof_name": name,
        "motion_type": motion,
        "center": np.asarray(center, dtype=float).tolist(),
        "direction": np.asarray(direction, dtype=float).tolist(),
        "children": children if children is None else list(children),
    }


def write_shape2motion(folder: Path, tree: dict, meshes: dict[str, trimesh.Trimesh]) -> Path:
    """The original layout: one mesh per moving part, the root's called `none_motion`."""
    for name, mesh in meshes.items():
        write_obj(folder / f"part_objs/{'none_motion' if name == tree['dof_name'] else name}.obj", mesh)
    (folder / "motion_attributes.json").write_text(json.dumps(tree))
    return folder


def write_mdv02(folder: Path, tree: dict, meshes: list[trimesh.Trimesh], numpy_integers: bool = False) -> Path:
    """The re-packed layout: all parts in one mesh, and a pickled map from its triangles to part numbers."""
    write_obj(folder / "summary.obj", trimesh.util.concatenate(meshes))
    parts = [part for part, mesh in enumerate(meshes) for _ in mesh.faces]
    kind = np.int64 if numpy_integers else int
    face_map = {kind(face): kind(part) for face, part in enumerate(parts)}
    np.save(folder / "sfs_idx_to_dof_name_idx.npy", face_map, allow_pickle=True)
    (folder / "motion_attributes.json").write_text(json.dumps(tree))
    return folder
