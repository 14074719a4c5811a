"""`articulate-ssl weights list|show|pack|rebuild|teach|check|test|ablate|columns`: those that come with the package."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

from rich.console import Console
from rich.table import Column, Table

from articulate_ssl.cli import BAD_INPUT
from articulate_ssl.inference.checkpoint_file import CheckpointError
from articulate_ssl.training.shipped_weights import WEIGHTS_FOLDER, shipped_as, shipped_weights
from articulate_ssl.training.weights_card import CARD_SUFFIX, HEADLINES, VIEWS, WeightsCard
from datamodules.manifest import ManifestError

# Of `HEADLINES`, as short as a table of all weights needs them.
_HEADINGS = ("R", ">30°", "flips", "T", "axis", "pivot", "state", "mIoU")
_NOT_REPRODUCED = 1  # the exit code
_BUILD = Path("build/weights")
_LESSONS = Path("build/weights-teach")
_CHECKS = Path("build/weights-check")
_CHECK_SEED = 12
_TESTS = Path("build/weights-test")
_ABLATIONS = Path("build/weights-ablate")
_ABLATION_SEED, _ABLATION_SAMPLES = 57, 240


def run(arguments: list[str]) -> int:
    """Do what the second word says.

    Returns:
        Exit code: 0; 1 if weights do not reproduce their cards, or some could not be rebuilt; 2 for bad input.

    Raises:
        SystemExit: of code 2 for bad arguments, with the usage on stderr; of code 0 for --help.
    """
    args = _parser().parse_args(arguments[1:])
    try:
        return args.do(args) if args.do in (_list, _show) else _computed(args)
    except (CheckpointError, ManifestError, OSError) as error:
        print(f"articulate-ssl weights: {error}", file=sys.stderr)
        return BAD_INPUT


def _computed(args: argparse.Namespace) -> int:
    from articulate_ssl.ops.denormals import flush_denormals

    with flush_denormals():
        return args.do(args)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="articulate-ssl weights", description="Weights that come with the package.")
    commands = parser.add_subparsers(required=True, metavar="list|show|pack|rebuild|teach|check|test|ablate|columns")
    listed = commands.add_parser("list", help="which there are, and what they are worth")
    listed.add_argument("--markdown", choices=list(VIEWS), metavar="VIEW", help="README's table of one view instead")
    listed.set_defaults(do=_list)

    show = commands.add_parser("show", help="print the card of one")
    show.add_argument("name", help="for example laptop-depth")
    show.set_defaults(do=_show)

    pack = commands.add_parser("pack", help="put a run that was trained and tested into the package")
    pack.add_argument("run", type=Path, help="its folder; the newest metrics.json under it counts")
    pack.add_argument("--checkpoint", type=Path, help="what was tested (default: as metrics.json says)")
    pack.add_argument("--commit", help="of the code that trained (default: that of the working folder)")
    pack.add_argument("--folder", type=Path, default=WEIGHTS_FOLDER, help="where to (default: the package)")
    pack.set_defaults(do=_pack)

    rebuild = commands.add_parser("rebuild", help="make data, train, test and pack; can be interrupted and goes on")
    rebuild.add_argument("--categories", nargs="+", help="default: all")
    rebuild.add_argument("--views", nargs="+", choices=list(VIEWS), default=list(VIEWS), help="default: both")
    rebuild.add_argument("--build", type=Path, default=_BUILD, help=f"for data, runs and logs (default: {_BUILD})")
    rebuild.add_argument("--folder", type=Path, default=WEIGHTS_FOLDER, help="where to (default: the package)")
    rebuild.set_defaults(do=_rebuild)

    teach = commands.add_parser("teach", help="what is learnt after training, anew: lessons without labels, and a test")
    teach.add_argument("names", nargs="+", help="categories or names")
    teach.add_argument("--lessons", nargs="+", help="default: all that apply; each builds on those before")
    teach.add_argument("--data", default="", help='by other data than the card says: "--test-instances 60 …"')
    teach.add_argument("--build", type=Path, default=_LESSONS, help=f"for data and notes (default: {_LESSONS})")
    teach.add_argument("--folder", type=Path, default=WEIGHTS_FOLDER, help="where to (default: the package)")
    teach.set_defaults(do=_teach)

    check = commands.add_parser("check", help="test on fresh data and compare with the cards")
    check.add_argument("names", nargs="*", help="categories or names (default: all)")
    check.add_argument("--seed", type=int, default=_CHECK_SEED, help=f"of the fresh data (default: {_CHECK_SEED})")
    check.add_argument("--build", type=Path, default=_CHECKS, help=f"for data and results (default: {_CHECKS})")
    check.set_defaults(do=_check)

    test = commands.add_parser("test", help="on labelled objects of yours, or CAD: a set that `make data` made")
    test.add_argument("names", nargs="+", help="categories or names")
    test.add_argument("--source", required=True, help="of the set: partnet-mobility, shape2motion, urdf, hoi4d")
    test.add_argument("--root", type=Path, default=Path("data"), help="where sets lie (default: data)")
    test.add_argument("--samples", type=int, help="test clouds at most (default: all)")
    test.add_argument("--build", type=Path, default=_TESTS, help=f"for calibration and results (default: {_TESTS})")
    test.set_defaults(do=_test)

    ablate = commands.add_parser("ablate", help="what is lost without each thing that was learnt after training")
    whole = "what part discovery finds without each thing it does, anew, with nothing learnt after it: an hour"
    ablate.add_argument("--discovery", action="store_true", help=whole)
    ablate.set_defaults(do=_ablate)
    columns = commands.add_parser("columns", help="no network, the network alone, and both: the same clouds")
    columns.set_defaults(do=_columns)
    for study in (ablate, columns):
        study.add_argument("names", nargs="+", help="categories or names")
        study.add_argument("--seed", type=int, default=_ABLATION_SEED, help=f"of the data (default: {_ABLATION_SEED})")
        samples = f"test clouds at most (default: {_ABLATION_SAMPLES})"
        study.add_argument("--samples", type=int, default=_ABLATION_SAMPLES, help=samples)
        study.add_argument("--source", help="test on a labelled set of this source instead, as `weights test` does")
        study.add_argument("--root", type=Path, default=Path("data"), help="where that lies (default: data)")
        place = f"for data and results (default: {_ABLATIONS})"
        study.add_argument("--build", type=Path, default=_ABLATIONS, help=place)
    return parser


def _list(args: argparse.Namespace) -> int:
    if args.markdown:
        from articulate_ssl.pretrained.markdown_table import as_markdown

        cards = (WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX)) for weights in shipped_weights())
        print(as_markdown(cards, args.markdown), end="")
        return 0
    headings = (Column(heading, no_wrap=True) for heading in ("weights", "MB", *_HEADINGS))
    # 80 columns hold no lines between them.
    table = Table(*headings, title="means over test clouds", box=None, pad_edge=False)
    named: dict[str, list[str]] = {}
    for weights in shipped_weights():
        card = WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX))
        if card.setting is not None:
            named.setdefault(card.setting, []).append(weights.name)
        means = (card.metrics[name]["mean"] for name in HEADLINES)
        cells = ("-" if mean is None else _short(mean) for mean in means)
        table.add_row(weights.name, f"{weights.file.stat().st_size / 1e6:.1f}", *cells)
    Console().print(table)
    for setting, names in named.items():
        print(f"{setting} (training knew which clouds show the same object): {', '.join(names)}")
    return 0


def _short(value: float) -> str:
    return f"{value:.1f}" if abs(value) >= 1 else f"{value:.2f}".lstrip("0")


def _show(args: argparse.Namespace) -> int:
    for weights in _named(args.name):
        print(WeightsCard.load(weights.file.with_suffix(CARD_SUFFIX)).markdown())
    return 0


def _pack(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained.pack import newest_metrics, pack
    from articulate_ssl.pretrained.rebuild import commit_of

    commit = args.commit or commit_of(Path.cwd())
    weights = pack(newest_metrics(args.run), args.checkpoint, commit, args.folder)
    print(f"wrote {weights.file} ({weights.file.stat().st_size / 1e6:.2f} MB) and its card")
    return 0


def _rebuild(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained.rebuild import CATEGORIES, rebuild

    failed = rebuild(args.build, _say, args.categories or CATEGORIES, args.views, args.folder)
    if failed:
        print("articulate-ssl weights: not all could be made:", *failed, sep="\n  ", file=sys.stderr)
    return _NOT_REPRODUCED if failed else 0


def _teach(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained.stages import StageFailed
    from articulate_ssl.pretrained.teach import Teaching
    from articulate_ssl.training.lessons import LESSONS

    try:
        for weights in [weights for name in args.names for weights in _named(name)]:
            lessons, data = tuple(args.lessons or LESSONS), tuple(shlex.split(args.data))
            print(Teaching(weights, lessons, args.build, args.folder, data).run(_say).markdown())
    except StageFailed as error:
        print(f"articulate-ssl weights: {error}", file=sys.stderr)
        return _NOT_REPRODUCED
    return 0


def _check(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained.check import check, more_than_chance

    chosen = [weights for name in args.names for weights in _named(name)] or list(shipped_weights())
    found = []
    for weights in chosen:
        comparisons = check(weights, args.seed, args.build, _say)
        table = Table("quantity", title=f"{weights.name} on fresh data of seed {args.seed}")
        for column in ("card", "fresh", "worse by chance up to"):
            table.add_column(column, justify="right")
        table.add_column("")
        for one in comparisons:
            verdict = "worse than the card" if one.worse else "reproduced"
            table.add_row(one.quantity, f"{one.card:.3g}", f"{one.fresh:.3g}", f"{one.allowed:.2g}", verdict)
        Console().print(table)
        found += comparisons
    worse = [f"{one.weights} {one.quantity}" for one in found if one.worse]
    print(f"{len(found) - len(worse)} of {len(found)} numbers reproduced", *worse, sep="\n  worse: ")
    if more_than_chance(found):
        print("more are worse than chance explains: the cards do not hold")
        return _NOT_REPRODUCED
    return 0


def _test(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained.elsewhere import measured_elsewhere

    for weights in [weights for name in args.names for weights in _named(name)]:
        _, place = measured_elsewhere(weights, args.source, args.root, args.build, _say, args.samples)
        print(f"{weights.name}: {place}/metrics.json, objects.csv and a picture")
    return 0


def _ablate(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained import ablation, discovery_ablation

    if not args.discovery:
        return _study(args, ablation.Study, ablation.as_markdown, elsewhere=_elsewhere(args))
    if args.source:
        raise CheckpointError("--source: part discovery is tested on clouds of --seed only; leave it out")
    return _study(args, discovery_ablation.DiscoveryStudy, discovery_ablation.as_markdown)


def _columns(args: argparse.Namespace) -> int:
    from articulate_ssl.pretrained.ablation import Study, columns_as_markdown

    return _study(args, Study, columns_as_markdown, "columns", elsewhere=_elsewhere(args))


def _elsewhere(args: argparse.Namespace) -> tuple[str, Path] | None:
    return (args.source, args.root) if args.source else None


def _study(args: argparse.Namespace, study: Callable, as_table: Callable, work: str = "run", **options) -> int:
    tested_on = f"{args.root}, {args.source}" if args.source else f"data seed {args.seed}"
    for weights in [weights for name in args.names for weights in _named(name)]:
        found = getattr(study(weights, args.seed, args.samples, args.build, **options), work)(_say)
        print(f"\n{weights.name}, {tested_on}, {found[0][1]['samples']} clouds\n\n{as_table(found)}")
    return 0


def _named(name: str):
    if not (found := shipped_as(name)):
        known = ", ".join(weights.name for weights in shipped_weights())
        raise CheckpointError(f"{name}: no such weights in the package; there are {known or 'none'}")
    return found


def _say(line: str) -> None:
    print(line, flush=True)
