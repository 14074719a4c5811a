"""`articulate-ssl twin scans/*.ply --parts 3 --joint prismatic`: one object from scans of it in several states."""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

from articulate_ssl.cli import BAD_INPUT

DEFAULT_FOLDER = Path("twin")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of the command."""
    parser.add_argument(
        "scans",
        type=Path,
        nargs="+",
        help="eight or more complete scans (.ply, .pcd, .npy, .npz or .obj) of ONE object, each in another state of "
        "its joints, in any orientation, all in the same unit",
    )
    parser.add_argument("--parts", type=int, required=True, help="how many parts move on their own, the base included")
    parser.add_argument("--joint", choices=["revolute", "prismatic"], default="revolute", help="what all joints are")
    parser.add_argument("--out", type=Path, default=DEFAULT_FOLDER, help=f"folder for the results ({DEFAULT_FOLDER})")
    parser.add_argument("--seed", type=int, default=0, help="of everything random; another may help where one fails")
    parser.add_argument("--html", action="store_true", help="also write a page to look at and move it in a browser")
    parser.add_argument(
        "--check", action="store_true", help="let MuJoCo drop it and move its joints, and say how it went"
    )


def run(arguments: list[str]) -> int:
    """Find parts and joints, write the results, print the states of all scans.

    Returns:
        Exit code: 0, or 2 for bad scans, or scans in which so many parts are not found, with one message on stderr.

    Raises:
        SystemExit: of code 2 for bad arguments, with the usage on stderr; of code 0 for --help.
    """
    parser = argparse.ArgumentParser(
        prog="articulate-ssl twin", description="Parts, joints and meshes of one object, from scans in several states."
    )
    add_arguments(parser)
    args = parser.parse_args(arguments[1:])
    if args.parts < 2:
        parser.error(f"--parts {args.parts}: an object that moves has at least two parts, its base included")
    repeated = [str(path) for path in dict.fromkeys(args.scans) if args.scans.count(path) > 1]
    if repeated:
        parser.error(f"{', '.join(repeated)}: given more than once; give each scan once")
    from articulate_ssl.discovery.discover import DiscoveryError
    from articulate_ssl.inference.export.formats import ExportError, demand_folder
    from articulate_ssl.ops.denormals import flush_denormals
    from datamodules.point_cloud_io import PointCloudError

    try:
        demand_folder(args.out)
        with flush_denormals():
            _twin(args)
    except (PointCloudError, DiscoveryError, ExportError, OSError) as error:
        print(f"articulate-ssl twin: {error}", file=sys.stderr)
        return BAD_INPUT
    return 0


def _twin(args: argparse.Namespace) -> None:
    from articulate_ssl.inference.twin import find_twin
    from articulate_ssl.ops.progress import shown
    from datamodules.point_cloud_io import load_point_cloud

    clouds = [load_point_cloud(path) for path in args.scans]
    with shown():
        twin = find_twin(clouds, args.parts, args.joint, args.seed)
    names = [path.name for path in args.scans]
    if len(set(names)) < len(names):  # scans of several folders
        names = [str(path) for path in args.scans]
    files = twin.export(args.out, names)
    if args.html:
        from articulate_ssl.inference.viewer import html_page

        files += html_page.write(twin.scans[0], args.out)
    table = Table("scan", *(joint.name for joint in twin.scans[0].joints), title="joint states")
    for name, state in zip(names, twin.states, strict=True):
        table.add_row(name, *(f"{math.degrees(s):.1f}°" if args.joint == "revolute" else f"{s:.4g}" for s in state))
    Console().print(table)
    print(
        f"scans lie on one another up to {twin.misfit:.2%} of the object's size in the median; "
        f"{twin.unexplained:.0%} of their points are off whichever part they move with"
    )
    print(f"wrote, as {names[0]} shows it:", *files, sep="\n  ")
    if args.check:
        from articulate_ssl.inference.export import physics_check

        print(*physics_check.check(args.out).lines(), sep="\n")
