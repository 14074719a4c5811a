"""The prediction in a browser beside this program: viser's server, with the controls of the static page.

What is shown is in the frame of the scan, moved to the origin and scaled to about one unit, because browsers draw in
single precision: a node at `position` stands at `position * scene.scale + scene.center` of the scan.
"""

from __future__ import annotations

import io
import socket
from contextlib import redirect_stdout
from threading import RLock
from types import TracebackType

import numpy as np
import viser
from viser.transforms import SO3

from articulate_ssl.inference.export.rigid_links import RigidJoint
from articulate_ssl.inference.pictures.part_colour import part_colour
from articulate_ssl.inference.pictures.viewpoint import AZIMUTH, ELEVATION
from articulate_ssl.inference.scan_prediction import ScanPrediction
from articulate_ssl.inference.viewer.scene import Hypothesis, Scene, scene_of

HOST = "127.0.0.1"
LAST_PORT = 65535
# Steps of a slider from end to end, at least: finer than a mouse.
SLIDER_STEPS = 1000
# In display units, chosen by eye.
POINT_SIZE, SHAFT_RADIUS, HEAD_RADIUS, HEAD_LENGTH, CAMERA_DISTANCE = 0.006, 0.009, 0.024, 0.07, 2.0
# Of viser's light, which washes the colours out at 1.
LIGHT = 0.5
FIELD_OF_VIEW = np.radians(40.0)
# Points are darker than the surfaces that they lie on, and arrows darker than both.
POINT_SHADE, ARROW_COLOUR = 0.6, (27, 31, 36)


class LiveViewer:
    """Serves a prediction until it is stopped; a context manager.

    Args:
        result: What to show.
        port: To listen on, at this machine's own address only; 0 takes a free one, and one that is taken the next.

    Raises:
        OSError: if neither this port nor any above it is free.

    Attributes:
        scene: What is shown.
        hypothesis: Which of `scene.hypotheses` is shown now.
        sliders: One per joint of it, in degrees or in the unit of the scan.
        part_nodes: Part k's node.
        axis_nodes: Joint j's arrow.
        next_button: Shows the next hypothesis.
    """

    def __init__(self, result: ScanPrediction, port: int = 8080) -> None:
        self.scene: Scene = scene_of(result)
        with redirect_stdout(io.StringIO()):  # viser's banner: who starts this says where it is in words of its own
            self._server = viser.ViserServer(host=HOST, port=_free_port(port), label="articulate-ssl", verbose=False)
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.scene.configure_environment_map(environment_intensity=LIGHT)
        self._place_camera()
        self._lock = RLock()  # viser calls back from several threads
        self._cloud = None
        self.part_nodes, self.axis_nodes, self.sliders = [], [], []
        self._add_panel()
        self._show(0)

    @property
    def url(self) -> str:
        """Where a browser finds the viewer."""
        return f"http://{HOST}:{self._server.get_port()}"

    @property
    def hypothesis(self) -> Hypothesis:
        """What is shown now."""
        return self.scene.hypotheses[self._index]

    def states(self) -> list[float]:
        """What the sliders say, within the joints' limits: radians, or lengths in the unit of the scan."""
        return [_state(joint, s.value) for joint, s in zip(self.hypothesis.joints, self.sliders, strict=True)]

    def wait(self) -> None:
        """Serve until the program is interrupted."""
        self._server.sleep_forever()

    def stop(self) -> None:
        """Close the server."""
        self._server.stop()

    def __enter__(self) -> LiveViewer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def _place_camera(self) -> None:
        right, up, front = self.scene.level
        self._server.scene.set_up_direction(up)
        level = np.cos(ELEVATION)
        towards = -np.sin(AZIMUTH) * level * right + np.sin(ELEVATION) * up + np.cos(AZIMUTH) * level * front
        self._server.initial_camera.look_at = np.zeros(3)
        self._server.initial_camera.position = CAMERA_DISTANCE * towards
        self._server.initial_camera.fov = FIELD_OF_VIEW

    def _add_panel(self) -> None:
        gui, scene = self._server.gui, self.scene
        gui.add_markdown(f"## {scene.category.replace('_', ' ').capitalize()}\n{scene.num_points:,} points")
        if scene.warning:
            gui.add_markdown(f"**{scene.warning}**")
        self._title = gui.add_markdown("")
        self.next_button = gui.add_button("Next hypothesis", visible=len(scene.hypotheses) > 1)
        self.next_button.on_click(lambda _: self._show((self._index + 1) % len(scene.hypotheses)))
        self._joint_folder = gui.add_folder("Joints")
        with gui.add_folder("Show"):
            self._shows = {name: gui.add_checkbox(name, True) for name in ("Scan", "Reconstruction", "Axes")}
        for checkbox in self._shows.values():
            checkbox.on_update(lambda _: self._set_visible())

    def _show(self, index: int) -> None:
        with self._lock, self._server.atomic():
            self._index = index
            hypothesis = self.hypothesis
            place = f"{index + 1} of {len(self.scene.hypotheses)}"
            self._title.content = f"**{hypothesis.title.capitalize()}** ({place}): {hypothesis.confidence}"
            self._add_nodes(hypothesis)
            self._add_sliders(hypothesis)
            self._move()
            self._set_visible()

    def _add_nodes(self, hypothesis: Hypothesis) -> None:
        scene, add = self.scene, self._server.scene
        for node in (*self.part_nodes, *self.axis_nodes):
            node.remove()
        # A node of the same name takes the old one's place.
        self._cloud = add.add_point_cloud(
            "/scan",
            ((scene.points - scene.center) / scene.scale).astype(np.float32),
            (POINT_SHADE * part_colour(hypothesis.part_id)).astype(np.uint8),
            point_size=POINT_SIZE,
            point_shape="circle",
            precision="float32",
        )
        self.part_nodes = [
            add.add_mesh_simple(
                f"/reconstruction/part_{k}",
                (mesh.vertices / scene.scale).astype(np.float32),
                mesh.faces,
                color=tuple(part_colour(k).tolist()),
            )
            for k, mesh in enumerate(hypothesis.meshes)
        ]
        self.axis_nodes = [
            add.add_arrows(
                f"/axes/{joint.name}",
                (arrow[[0, 2]] / scene.scale).astype(np.float32)[None],
                ARROW_COLOUR,
                shaft_radius=SHAFT_RADIUS,
                head_radius=HEAD_RADIUS,
                head_length=HEAD_LENGTH,
            )
            for joint, arrow in zip(hypothesis.joints, hypothesis.arrows, strict=True)
        ]

    def _add_sliders(self, hypothesis: Hypothesis) -> None:
        for slider in self.sliders:
            slider.remove()
        self._joint_folder.visible = bool(hypothesis.joints)
        self.sliders = []
        with self._joint_folder:
            for joint in hypothesis.joints:
                lower, upper, state = (_shown_state(joint, s) for s in (joint.lower, joint.upper, joint.state))
                does = "turns (degrees)" if joint.kind == "revolute" else "slides (unit of the scan)"
                # A round step, and ends rounded outwards to it, because viser prints all digits of the ends.
                digits = int(np.ceil(np.log10(SLIDER_STEPS / (upper - lower))))
                step = 10.0**-digits
                slider = self._server.gui.add_slider(
                    joint.name.replace("_", " "),
                    min=round(np.floor(lower / step) * step, digits),
                    max=round(np.ceil(upper / step) * step, digits),
                    step=step,
                    initial_value=state,
                    hint=f"part {joint.child} {does} on part {joint.parent}",
                )
                slider.on_update(lambda _: self._move())
                self.sliders.append(slider)

    def _move(self) -> None:
        with self._lock, self._server.atomic():
            poses = self.hypothesis.poses(self.states())
            for node, pose in zip(self.part_nodes, poses, strict=True):
                self._place(node, pose)
            for node, joint in zip(self.axis_nodes, self.hypothesis.joints, strict=True):
                self._place(node, poses[joint.parent])

    def _place(self, node: viser.SceneNodeHandle, pose: np.ndarray) -> None:
        node.wxyz = SO3.from_matrix(pose[:3, :3]).wxyz
        node.position = (pose[:3, 3] - self.scene.center) / self.scene.scale

    def _set_visible(self) -> None:
        for name, nodes in zip(self._shows, ([self._cloud], self.part_nodes, self.axis_nodes), strict=True):
            for node in nodes:
                node.visible = self._shows[name].value


def _free_port(wanted: int) -> int:
    """The first free port from one on; 0 stays. viser waits for ever behind the last."""
    for port in range(wanted, LAST_PORT + 1):
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as viser does: a port that was just left
            try:
                probe.bind((HOST, port))
            except OSError:
                continue
            return port
    raise OSError(f"no port from {wanted} to {LAST_PORT} is free at {HOST}; take a lower one, or 0 for any")


def _shown_state(joint: RigidJoint, state: float) -> float:
    """Degrees, or the unit of the scan."""
    return float(np.degrees(state)) if joint.kind == "revolute" else state


def _state(joint: RigidJoint, shown: float) -> float:
    state = float(np.radians(shown)) if joint.kind == "revolute" else shown
    return min(max(state, joint.lower), joint.upper)
