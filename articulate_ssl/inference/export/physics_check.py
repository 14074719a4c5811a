"""Let MuJoCo try what was exported: load it, drop it, and move its joints.

Scans have no unit, but gravity and contacts do: the object is simulated in metres, by a factor that the caller states
or that makes the object `ASSUMED_SIZE` large. Lengths, masses (of the same density) and inertias are scaled before
MuJoCo compiles the model; the files stay as they are. MuJoCo collides convex hulls, and so does this check.

It needs mujoco (the extra `mujoco`), which is imported when something is checked.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh
from lxml import etree

from articulate_ssl.inference.export.formats import ExportError
from articulate_ssl.inference.export.rigid_links import MESH_FOLDER

if TYPE_CHECKING:
    import mujoco

MODEL_FILES = ("object.xml", "object.urdf")
# Metres. Between a pair of glasses and an oven; sizes only change how soft contacts are, and how long a fall takes.
ASSUMED_SIZE = 0.5
STEP_SECONDS = 0.002
GRAVITY = 9.81

# The numbers from here on were chosen without a measurement, generously: they are to find broken models, not bad ones.
DROP_HEIGHT = 0.1  # of the object's size
# At rest, no vertex moves further than this (object sizes) within this time. Contacts of meshes jitter, in MuJoCo
# before version 4 by some hundredths of a size per second, so speeds tell nothing.
REST_DRIFT = 0.01
REST_SECONDS = 0.5
MAX_FALL_SECONDS = 20.0
MAX_SINKING = 0.02  # object sizes below the floor
# An undamped joint swings for ever, and files state no damping, because no cloud tells it.
JOINT_SETTLING_SECONDS = 0.1
# Torsional and rolling friction (metres), without which round objects roll for ever.
FLOOR_FRICTION = (1.0, 0.01, 0.01)

# Angular frequency of the springs that pull a joint along, per second; critically damped.
PULL = 10.0
SWEEP_SECONDS = 2.0
# How far beyond its limits a joint is pulled, which must hold it, and how far it may go: shares of its range.
PULL_BEYOND = 0.1
MAX_BEYOND = 0.02
MIN_COVERED = 0.95

# Share of the smaller part's volume. Reconstructions are not exact enough to refuse one for more.
OVERLAP_WORTH_A_NOTE = 0.02


class PhysicsCheckError(ExportError):
    """The check cannot be made; the message says what to do."""


@dataclass(frozen=True)
class JointVerdict:
    """How one joint moved while the base was held and no gravity acted.

    Attributes:
        name: As in the file.
        covered: Share of its range that it went through, from 0 to 1.
        beyond: How far it left its limits, as a share of its range.
    """

    name: str
    covered: float
    beyond: float

    @property
    def passed(self) -> bool:
        return self.covered >= MIN_COVERED and self.beyond <= MAX_BEYOND


@dataclass(frozen=True)
class FileVerdict:
    """What MuJoCo made of one file.

    Attributes:
        file: Its name.
        problem: Why it does not load; None if it does. Otherwise nothing below was tried.
        mass: Kilograms, of all parts, at the size that was simulated.
        masses_positive: Of every part, and all its moments of inertia.
        finite: No state left the numbers, in the fall or in the joints' sweeps.
        fall_seconds: Until it came to rest, in steps of `REST_SECONDS`; infinite if it did not.
        sinking: How deep below the floor its lowest point ended, in object sizes.
        joints: One verdict each.
        overlap: Largest share of a part's volume that lies in another part, in the state of the scan where the file
            tells it (MJCF), else at state zero; NaN if the meshes of two parts cannot be intersected.
    """

    file: str
    problem: str | None = None
    mass: float = 0.0
    masses_positive: bool = False
    finite: bool = False
    fall_seconds: float = float("nan")
    sinking: float = float("nan")
    joints: tuple[JointVerdict, ...] = ()
    overlap: float = float("nan")

    @property
    def rests(self) -> bool:
        """On the floor, and without motion."""
        return self.fall_seconds <= MAX_FALL_SECONDS and self.sinking <= MAX_SINKING

    @property
    def passed(self) -> bool:
        """All but the overlap, which is a note: it says as much about the reconstruction as about the export."""
        moves = self.finite and self.rests and all(joint.passed for joint in self.joints)
        return self.problem is None and self.masses_positive and moves

    def lines(self) -> list[str]:
        """One line for each thing that was tried."""
        if self.problem is not None:
            return [f"{self.file}: FAILED, MuJoCo does not load it: {self.problem}"]
        rows = [
            (self.masses_positive, f"mass {self.mass:.3g} kg, inertias positive"),
            (self.finite, "all states stay finite"),
            (self.rests, self._fall()),
            *(
                (j.passed, f"{j.name} covers {j.covered:.0%} of its range, and goes {j.beyond:.1%} beyond its limits")
                for j in self.joints
            ),
        ]
        note = f"parts share {self.overlap:.1%} of the smaller one's volume"
        if np.isnan(self.overlap):
            note = "parts' meshes cannot be intersected"
        mark = "ok" if self.overlap <= OVERLAP_WORTH_A_NOTE else "note"
        marked = [f"  {'ok' if passed else 'FAILED':6}  {text}" for passed, text in rows]
        return [f"{self.file}: loads", *marked, f"  {mark:6}  {note}"]

    def _fall(self) -> str:
        if not np.isfinite(self.fall_seconds):
            return f"dropped, it still moves after {MAX_FALL_SECONDS:.0f} s"
        return f"dropped, it rests after {self.fall_seconds:.1f} s, {self.sinking:.1%} of its size in the floor"


@dataclass(frozen=True)
class PhysicsVerdict:
    """What MuJoCo made of an exported object.

    Attributes:
        metres_per_unit: What it was simulated with.
        assumed: Nobody stated that number; it makes the object `ASSUMED_SIZE` large.
        files: One verdict for each file found.
    """

    metres_per_unit: float
    assumed: bool
    files: tuple[FileVerdict, ...]

    @property
    def passed(self) -> bool:
        return all(file.passed for file in self.files)

    def lines(self) -> list[str]:
        """The verdict for people, a line for each thing."""
        unit = f"simulated with {self.metres_per_unit:.3g} metres to the scan's unit"
        if self.assumed:
            unit += f", which makes the object {ASSUMED_SIZE} m large (the unit is unknown)"
        verdict = "physics check passed" if self.passed else "physics check FAILED"
        return [f"{verdict}; {unit}", *(line for file in self.files for line in file.lines())]


def check(
    folder: str | os.PathLike,
    metres_per_unit: float | None = None,
    names: Sequence[str] = MODEL_FILES,
) -> PhysicsVerdict:
    """Try the models that are in a folder of exports.

    Each is dropped on a plane with its joints free, then held by its base while every joint is pulled through its range
    and against both its limits.

    Args:
        folder: Where `urdf.write` or `mjcf.write` wrote.
        metres_per_unit: Size of the scan's unit (.001 for millimetres); None makes the object `ASSUMED_SIZE` large.
        names: Of `MODEL_FILES`, those that are tried where they are there.

    Raises:
        PhysicsCheckError: if mujoco is not installed, the folder holds nothing to check, or the unit is not positive.
    """
    _demand_mujoco()
    folder = Path(folder)
    files = [folder / name for name in MODEL_FILES if name in names and (folder / name).is_file()]
    meshes = sorted({mesh for file in files for mesh in _meshes(file)})
    if not files or not meshes:
        raise PhysicsCheckError(
            f"{folder}: holds no {' or '.join(MODEL_FILES)} with its {MESH_FOLDER}; export urdf or mjcf there first"
        )
    size = float(np.ptp([trimesh.load_mesh(mesh).bounds for mesh in meshes], axis=(0, 1)).max())
    scale = ASSUMED_SIZE / size if metres_per_unit is None else metres_per_unit
    if not (scale > 0 and np.isfinite(scale)):
        raise PhysicsCheckError(f"metres per unit must be a positive number, got {metres_per_unit}")
    verdicts = tuple(_check_file(file, scale, scale * size) for file in files)
    return PhysicsVerdict(scale, metres_per_unit is None, verdicts)


def _meshes(model: Path) -> list[Path]:
    """The files of meshes that a model names and that are there: the folder may hold those of another object, too."""
    try:
        root = etree.parse(model)
    except etree.XMLSyntaxError:  # MuJoCo says what is wrong with it
        return []
    named = [mesh.get("file") or mesh.get("filename") for mesh in root.iter("mesh")]
    files = [model.parent / MESH_FOLDER / Path(name).name for name in named if name]
    return [file for file in files if file.is_file()]


def _demand_mujoco() -> None:
    try:
        import mujoco  # noqa: F401
    except ImportError as error:
        raise PhysicsCheckError(
            "the physics check needs the package mujoco, which is not installed; pip install 'articulate-ssl[mujoco]'"
        ) from error


def _check_file(file: Path, scale: float, size: float) -> FileVerdict:
    try:
        model = _load(file, scale).compile()
    except ValueError as error:
        return FileVerdict(file.name, problem=" ".join(str(error).split()))
    states = _scan_states(model)
    falls, fall_seconds, sinking = _drop(file, scale, size, states)
    moves, joints = _sweep(model, states)
    return FileVerdict(
        file=file.name,
        mass=float(model.body_mass.sum()),
        masses_positive=bool((model.body_mass[1:] > 0).all() and (model.body_inertia[1:] > 0).all()),
        finite=falls and moves,
        fall_seconds=fall_seconds,
        sinking=sinking,
        joints=joints,
        overlap=_overlap(model, states),
    )


def _load(file: Path, scale: float) -> mujoco.MjSpec:
    """The model in metres, with the collision pairs of joints left out in any format."""
    import mujoco

    spec = mujoco.MjSpec.from_file(str(file))
    spec.option.timestep = STEP_SECONDS
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for mesh in spec.meshes:
        mesh.scale = mesh.scale * scale
    for geom in spec.geoms:
        geom.pos = geom.pos * scale
    excluded = {frozenset((pair.bodyname1, pair.bodyname2)) for pair in spec.excludes}
    for body in spec.bodies[1:]:
        body.pos, body.ipos = body.pos * scale, body.ipos * scale
        body.mass *= scale**3
        body.inertia, body.fullinertia = body.inertia * scale**5, body.fullinertia * scale**5
        pair = (body.parent.name, body.name)
        if body.parent.name != "world" and frozenset(pair) not in excluded:
            spec.add_exclude(bodyname1=pair[0], bodyname2=pair[1])
    sliding = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_SLIDE]
    for joint in sliding:
        joint.range = joint.range * scale
    for key in spec.keys:
        key.qpos = [q * (scale if joint in sliding else 1) for q, joint in zip(key.qpos, spec.joints, strict=True)]
    return spec


def _scan_states(model: mujoco.MjModel) -> np.ndarray:  # [J]
    states = model.key_qpos[0] if model.nkey else np.zeros(model.nq)
    return np.clip(states, model.jnt_range[:, 0], model.jnt_range[:, 1])


def _drop(
    file: Path,
    scale: float,
    size: float,
    states: np.ndarray,  # [J]
) -> tuple[bool, float, float]:
    """Whether all stays finite, seconds until it rests, and its depth below the floor at the end in object sizes."""
    import mujoco

    spec = _load(file, scale)
    for key in list(spec.keys):
        spec.delete(key)
    spec.option.gravity = [0, 0, -GRAVITY]
    spec.worldbody.first_body().add_freejoint()
    plane = dict(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1], condim=6, friction=FLOOR_FRICTION)
    spec.worldbody.add_geom(name="floor", **plane)
    model = spec.compile()
    data = mujoco.MjData(model)
    model.dof_damping[6:] = model.dof_M0[6:] / JOINT_SETTLING_SECONDS
    data.qpos[:3], data.qpos[7:] = 0, states
    data.qpos[2] = DROP_HEIGHT * size - _lowest(model, data)
    seconds = _seconds_until_rest(model, data, size)
    return _is_finite(data), seconds, float(max(0.0, -_lowest(model, data)) / size)


def _seconds_until_rest(model: mujoco.MjModel, data: mujoco.MjData, size: float) -> float:
    import mujoco

    before = _all_vertices(model, data)
    for window in range(_num_steps(MAX_FALL_SECONDS) // _num_steps(REST_SECONDS)):
        mujoco.mj_step(model, data, nstep=_num_steps(REST_SECONDS))
        after = _all_vertices(model, data)
        # NaN is no rest, because no comparison with it holds.
        if np.linalg.norm(after - before, axis=1).max() <= REST_DRIFT * size:
            return window * REST_SECONDS
        before = after
    return float("inf")


def _all_vertices(model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:  # [V, 3] world
    import mujoco

    mujoco.mj_kinematics(model, data)
    return np.concatenate([vertices for vertices, _ in _posed_meshes(model, data)])


def _sweep(
    model: mujoco.MjModel,
    states: np.ndarray,  # [J]
) -> tuple[bool, tuple[JointVerdict, ...]]:
    import mujoco

    model.opt.gravity[:] = 0
    finite, verdicts = True, []
    for j in range(model.njnt):
        data = mujoco.MjData(model)
        data.qpos[:] = states
        lower, upper = model.jnt_range[j]
        margin = PULL_BEYOND * (upper - lower)
        visited = [states[j]]
        for goal in (upper + margin, lower - margin):
            start, steps = data.qpos[j], _num_steps(SWEEP_SECONDS)
            # The pull reaches its goal after three quarters of the time; the rest is for the joint to follow.
            ramp = np.minimum(1, np.arange(steps) / (0.75 * steps))
            for target in start + ramp * (goal - start):
                targets = states.copy()
                targets[j] = target
                data.qfrc_applied[:] = model.dof_M0 * (PULL**2 * (targets - data.qpos) - 2 * PULL * data.qvel)
                mujoco.mj_step(model, data)
                visited.append(data.qpos[j])
        span = upper - lower
        low, high = min(visited), max(visited)
        finite &= _is_finite(data)
        covered = (min(high, upper) - max(low, lower)) / span
        beyond = max(0.0, high - upper, lower - low) / span
        verdicts.append(JointVerdict(model.joint(j).name, float(covered), float(beyond)))
    return bool(finite), tuple(verdicts)


def _num_steps(seconds: float) -> int:
    return round(seconds / STEP_SECONDS)


def _is_finite(data: mujoco.MjData) -> bool:
    # MuJoCo starts again from the initial state where numbers diverge, and counts that as a warning.
    import mujoco

    bad = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)
    return bool(np.isfinite(data.qpos).all()) and not any(data.warning[int(kind)].number for kind in bad)


def _lowest(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    return float(_all_vertices(model, data)[:, 2].min())


def _posed_meshes(
    model: mujoco.MjModel, data: mujoco.MjData
) -> Iterator[tuple[np.ndarray, np.ndarray]]:  # [V, 3] world, [F, 3]
    for geom in range(model.ngeom):
        mesh = model.geom_dataid[geom]
        if mesh >= 0:
            start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
            first, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
            rotation = data.geom_xmat[geom].reshape(3, 3)
            vertices = model.mesh_vert[start : start + count] @ rotation.T + data.geom_xpos[geom]
            yield vertices, model.mesh_face[first : first + faces]


def _overlap(
    model: mujoco.MjModel,
    states: np.ndarray,  # [J]
) -> float:
    import mujoco

    data = mujoco.MjData(model)
    data.qpos[:] = states
    mujoco.mj_forward(model, data)
    meshes = [trimesh.Trimesh(*mesh) for mesh in _posed_meshes(model, data)]
    if not all(mesh.is_volume for mesh in meshes):
        return float("nan")
    with np.errstate(divide="ignore", invalid="ignore"):  # where two parts only touch
        shared = [trimesh.boolean.intersection(pair).volume for pair in combinations(meshes, 2)]
    smaller = [min(a.volume, b.volume) for a, b in combinations(meshes, 2)]
    return max((float(a / b) for a, b in zip(shared, smaller, strict=True)), default=0.0)
