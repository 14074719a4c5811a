"""The prediction as one HTML file that opens by double-click, without this program and without a network.

Why a page of our own: viser's static export (`SceneApi.as_html`, viser 1.1) plays a recorded scene back and leaves all
its controls out, so that no slider would move anything. The drawing is three.js (MIT), the library under viser too: two
files of release 0.170.0 as npm ships them, the last release whose minified build is a single module, in `three/`. The
page finds them by an import map of data: URLs, because a page from disk may not import its neighbours. It weighs 1 MB.

Convention:
    `page/page.js` reads `describe`. Its forward kinematics are `articulation.part_motion` again, in double precision;
    `window.articulated.transforms()` says where the drawn parts are, for the test that compares the two.
"""

from __future__ import annotations

import base64
import html
import json
from importlib.resources import files
from pathlib import Path

import numpy as np

from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.scan_prediction import ScanPrediction
from articulate_ssl.inference.viewer.scene import Hypothesis, Scene, scene_of
from datamodules.atomic import atomic_write

# What `page.js` calls the modules in `three/`; `three` is also what OrbitControls calls the other.
MODULES = {"three": "three.module.min.js", "orbit-controls": "OrbitControls.js"}


def write(result: ScanPrediction, folder: Path) -> list[Path]:
    """Write `view.html`; return it."""
    file = folder / "view.html"
    content = page(scene_of(result)).encode()
    with atomic_write(file) as opened:
        opened.write(content)
    return [file]


def page(scene: Scene) -> str:
    """The whole page."""
    imports = {name: f"data:text/javascript;base64,{_base64(_read(f'three/{file}'))}" for name, file in MODULES.items()}
    return _filled(
        _read("page/page.html").decode(),
        title=html.escape(f"{scene.category.replace('_', ' ')}: prediction"),
        licence=_read("three/LICENSE").decode(),
        style=_read("page/page.css").decode(),
        scene=_json(describe(scene)),
        imports=_json({"imports": imports}),
        script=_read("page/page.js").decode(),
    )


def describe(scene: Scene) -> dict:
    """What the page knows: numbers in the frame and the units of the scan, arrays as base64 of little-endian numbers.

    Points are stored as (x - center) / scale, in single precision; meshes in canonical object space; matrices as lists
    of rows that act on column vectors.
    """
    return {
        "category": scene.category,
        "warning": scene.warning,
        "numPoints": scene.num_points,
        "center": scene.center.tolist(),
        "scale": scene.scale,
        "level": scene.level.tolist(),
        "points": _array((scene.points - scene.center) / scene.scale, "<f4"),
        "hypotheses": [_describe(hypothesis) for hypothesis in scene.hypotheses],
    }


def _describe(hypothesis: Hypothesis) -> dict:
    prediction = hypothesis.prediction
    axis, pivot = prediction.canonical_axis[0].tolist(), prediction.canonical_pivot[0].tolist()
    return {
        "title": hypothesis.title,
        "confidence": hypothesis.confidence,
        "basePose": prediction.base_pose[0].tolist(),
        "partOfPoint": _array(hypothesis.part_id, "u1"),
        "parts": [
            {
                "colour": (part_colour(k) / 255).tolist(),
                "vertices": _array(mesh.vertices, "<f4"),
                "normals": _array(mesh.vertex_normals, "<f4"),
                "faces": _array(mesh.faces, "<u4"),
            }
            for k, mesh in enumerate(hypothesis.meshes)
        ],
        "joints": [
            {
                "name": joint.name,
                "kind": joint.kind,
                "parent": joint.parent,
                "child": joint.child,
                "axis": axis[j],
                "pivot": pivot[j],
                "lower": joint.lower,
                "upper": joint.upper,
                "state": joint.state,
                "arrow": hypothesis.arrows[j].tolist(),
            }
            for j, joint in enumerate(hypothesis.joints)
        ],
    }


def _filled(template: str, **values: str) -> str:
    """The template with `{{name}}` replaced; values are not searched for names in turn."""
    pieces = template.split("{{")
    filled = [piece.partition("}}") for piece in pieces[1:]]
    return pieces[0] + "".join(values[name] + rest for name, _, rest in filled)


def _json(content: dict) -> str:
    """JSON that cannot end the script element that holds it."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def _array(values: np.ndarray, kind: str) -> str:
    return _base64(np.ascontiguousarray(values, dtype=kind).tobytes())


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def _read(name: str) -> bytes:
    return files(__package__).joinpath(name).read_bytes()
