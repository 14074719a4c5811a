"""One table from many jobs: what is in it, what its intervals are, and that nothing is done twice."""

import contextlib
import csv
import json
import math
from pathlib import Path

import matplotlib.image
import pytest
import yaml

from articulate_ssl.baselines import METHODS
from articulate_ssl.comparison import __main__ as command
from articulate_ssl.comparison import jobs as jobs_module
from articulate_ssl.comparison.figure import LEVELS, level
from articulate_ssl.comparison.jobs import Job, Setting, make_data
from articulate_ssl.comparison.measured import Measured
from articulate_ssl.comparison.results import Results, RowResult, collect
from articulate_ssl.comparison.rows import MULTI_STATE, QUANTITIES, Row, learners, rows_of
from articulate_ssl.comparison.spread import do_jobs
from articulate_ssl.comparison.statistics import Estimate, combined
from articulate_ssl.comparison.table import as_markdown
from articulate_ssl.pretrained.rebuild import COMPLETE_OPTIONS
from articulate_ssl.pretrained.stages import StageFailed
from articulate_ssl.training.recipes import RECIPES


def _statistic(mean, half=1.0, **more) -> dict:
    ci95 = None if half is None else [mean - half, mean + half]
    return {"mean": mean, "median": mean, "ci95": ci95} | more


def _report(shift: float = 0.0) -> dict:
    parts = {"parts": [_statistic(3.0 + shift), _statistic(5.0 + shift)]}
    report = {name: _statistic(0.5, 0.1) for said in QUANTITIES.values() for name in said}
    report |= {"r_err_deg": _statistic(4.0 + shift, **parts), "legacy_r_err_deg": _statistic(2.0, **parts)}
    about = {"part_names": ["base", "lid"], "samples": 8, "instances": 4, "calibration": {"joint_type": [0]}}
    return report | about | {"train_seconds": 60.0, "seconds_per_cloud": 0.5, "parameters": 12345}


class _Programs:
    """Stands in for the programs of all jobs: leaves their reports."""

    def __init__(self) -> None:
        self.commands, self.fails = [], ""

    def __call__(self, command, log: Path, lock, tick) -> int:
        self.commands.append(list(command))
        log.write_text("words")
        if self.fails and self.fails in command:
            return 1
        if "articulate_ssl.baselines" in command:
            seed = float(command[command.index("--seed") + 1])
            out = Path(command[command.index("--out") + 1])
            if "--test-source" in command:
                out, seed = out / f"tested-on-{command[command.index('--test-source') + 1]}", seed + 10
                out.mkdir(exist_ok=True)
            (out / "metrics.json").write_text(json.dumps(_report(seed)))
        return 0

    @property
    def names(self) -> list[str]:
        return [command[3] for command in self.commands]


@pytest.fixture
def programs(monkeypatch):
    programs = _Programs()
    monkeypatch.setattr("articulate_ssl.pretrained.stages.run_program", programs)
    return programs


def _setting(tmp_path, view="complete", **options) -> Setting:
    return Setting("laptop", view, tmp_path / "build", tmp_path / "data", **options)


def test_seeds_and_objects_are_both_in_the_interval():
    assert combined([_statistic(4.0, 1.0)]) == Estimate(4.0, 3.0, 5.0, (4.0,))
    several = combined([_statistic(3.0, 1.0), _statistic(4.0, 1.0), _statistic(5.0, 1.0)])
    seeds = 4.302653 * 1.0 / math.sqrt(3)  # Student's 97.5 % quantile of two degrees of freedom
    assert several.mean == 4.0
    assert several.high - 4.0 == pytest.approx(math.hypot(1.0, seeds), rel=1e-6)
    # Seeds that agree leave the objects' interval as it is: the objects are the same.
    assert combined([_statistic(4.0, 1.0)] * 3) == Estimate(4.0, 3.0, 5.0, (4.0,) * 3)
    assert combined([_statistic(4.0, None)] * 2) == Estimate(4.0, None, None, (4.0,) * 2)
    assert combined([_statistic(4.0), {"mean": None, "median": None, "ci95": None}]) is None


def test_no_interval_reaches_beyond_what_is_possible(tmp_path, monkeypatch):
    far_apart = [_statistic(0.28, 0.01), _statistic(0.97, 0.01), _statistic(0.28, 0.01)]
    assert combined(far_apart).high > 1  # of an error nothing forbids it
    share = combined(far_apart, largest=1.0)
    assert (share.low, share.high, share.of_seeds) == (0.0, 1.0, (0.28, 0.97, 0.28))
    monkeypatch.setattr(Job, "finished", True)
    ious = {"seg_miou": _statistic(0.28, 0.01)}, {"seg_miou": _statistic(0.97, 0.01)}
    monkeypatch.setattr(Job, "report", lambda job, _column: _report(170.0 * job.seed) | ious[job.seed])
    (row,) = collect(_setting(tmp_path), ["oracle_icp"], [0, 1], []).rows
    assert row.value("r_err_deg").of_seeds == (4.0, 174.0)
    assert (row.value("r_err_deg").low, row.value("r_err_deg").high) == (0.0, 180.0)
    assert (row.value("seg_miou").low, row.value("seg_miou").high) == (0.0, 1.0)


def test_every_learner_has_rows_with_names_of_their_own():
    rows = [row for name in learners() for row in rows_of(name)]
    assert len({row.name for row in rows}) == len({row.title for row in rows}) == len(rows)
    assert {row.learner for row in rows} == {*METHODS, *RECIPES, MULTI_STATE}
    assert [row.column for row in rows_of("staged")] == ["no_network", "network", "network_registered"]
    assert [row.column for row in rows_of(MULTI_STATE)] == ["no_network", "network", "network_registered"]
    assert [row.column for row in rows_of("paper")] == ["network", "network_registered"]
    with pytest.raises(ValueError, match="npcs_epn"):
        rows_of("magic")


def test_commands_are_those_that_the_programs_take(tmp_path):
    from articulate_ssl.baselines.__main__ import _parser as methods_parser

    (method,) = Job(_setting(tmp_path, "partial", steps=7), "oracle_icp", 2).stages()
    args = methods_parser().parse_args(method.command[3:])
    assert (args.method, args.view, args.seed, args.steps, args.samples) == ("oracle_icp", "partial", 2, 7, 300)
    assert args.orientation_range == 100.0
    fit, test = Job(_setting(tmp_path, configs=(Path("more.yaml"),)), "staged", 1).stages()
    assert fit.command[3:6] == ("fit", "-c", "configs/laptop.yaml")
    assert test.command[4 : len(fit.command)] == fit.command[4:]
    assert test.command[len(fit.command) :] == ("--model.inference.columns", "true")
    words = " ".join(fit.command)
    assert "-c configs/profiles/cpu.yaml --seed_everything 1 -c more.yaml --model.recipe staged" in words
    assert all(file.is_file() for files in jobs_module.RECIPE_CONFIGS.values() for file in files)
    other = {"test_source": "shape2motion", "test_root": tmp_path / "mine"}
    same, method = Job(_setting(tmp_path, **other), "oracle_icp", 2).stages()
    assert same == Job(_setting(tmp_path), "oracle_icp", 2).stages()[0]
    args = methods_parser().parse_args(method.command[3:])
    assert (args.test_source, args.test_root) == ("shape2motion", str(tmp_path / "mine"))
    *same, other_test = Job(_setting(tmp_path, **other), "staged", 1).stages()
    assert tuple(same) == Job(_setting(tmp_path), "staged", 1).stages()
    assert other_test.command[: len(same[1].command)] == same[1].command
    fit, _ = Job(_setting(tmp_path, configs=(Path("more.yaml"),)), "paper", 1).stages()
    assert "-c configs/profiles/paper_recipe.yaml -c more.yaml --model.recipe paper" in " ".join(fit.command)


def _value(command, option: str) -> str:
    """What counts of an option that is given several times: the last."""
    words = list(command)
    return words[len(words) - words[::-1].index(option)]


@pytest.mark.parametrize("view", ["complete", "partial"])
def test_the_multi_state_setting_learns_from_other_objects_and_is_tested_on_the_same(tmp_path, programs, view):
    setting = _setting(tmp_path, view)
    fit, test = Job(setting, MULTI_STATE, 1).stages()
    _, single = Job(setting, "staged", 1).stages()
    assert _value(test.command, "--data.root") == _value(single.command, "--data.root") == str(setting.root)
    assert _value(fit.command, "--model.recipe") == "staged"
    profile = {"complete": "multi_state", "partial": "depth_from_scans"}[view]
    assert f"configs/profiles/{profile}.yaml" in fit.command
    assert _value(fit.command, "--data.scans") == _value(test.command, "--data.scans") == str(setting.scans)
    assert _value(fit.command, "--data.root") == str(setting.root)

    make_data(setting, ("staged",), print)
    assert len(programs.commands) == 1
    programs.commands.clear()
    make_data(setting, (MULTI_STATE,), print)
    scans, views = programs.commands
    assert _value(scans, "--out") == str(setting.scans_root)
    assert _value(scans, "--view") == "complete"
    assert _value(scans, "--seed") != _value(views, "--seed")
    assert int(_value(scans, "--states")) >= 8


def test_data_are_made_once_and_occupancy_is_added_only_if_needed(tmp_path, programs, synthetic_set, monkeypatch):
    setting = _setting(tmp_path, data_options=("--states", "6"))
    make_data(setting, ("oracle_icp",), print)
    (words,) = [" ".join(command) for command in programs.commands]
    assert "--category laptop --view complete --seed 21 " in words and "--occupancy" not in words
    assert " ".join([*COMPLETE_OPTIONS, "--states", "6", "--out"]) in words  # the user's options have the last word
    made = Setting("laptop", "complete", tmp_path, synthetic_set.parents[1])
    make_data(made, ("oracle_icp",), print)
    assert len(programs.commands) == 1
    monkeypatch.setattr(jobs_module, "generate_arguments", lambda _manifest: ["--seed", "5"])
    make_data(made, ("bae_net",), print)
    assert "--seed 5 --occupancy 2048" in " ".join(programs.commands[-1])


@pytest.mark.parametrize("workers", [1, 2])
def test_finished_jobs_are_not_repeated_and_a_failure_stops_no_other(tmp_path, programs, workers):
    setting = _setting(tmp_path)
    jobs = [Job(setting, name, seed) for seed in (0, 1) for name in ("oracle_icp", "op_align")]
    programs.fails = "op_align"
    done = []
    failed = do_jobs(jobs, workers, done=done.append)
    assert [(job.learner, job.seed) for job in sorted(done, key=lambda job: job.seed)] == [
        ("oracle_icp", 0),
        ("oracle_icp", 1),
    ]
    assert {job.learner for job in failed} == {"op_align"} and all("method.log" in why for why in failed.values())
    assert [job.finished for job in jobs] == [True, False, True, False]
    programs.fails, count = "", len(programs.commands)
    assert do_jobs([job for job in jobs if not job.finished], workers) == {}
    assert programs.names[count:] == ["op_align"] * 2
    assert all(job.finished for job in jobs)


def test_a_job_that_was_cut_off_is_gone_on_with(tmp_path, programs):
    job = Job(_setting(tmp_path), "staged", 0)
    programs.fails = "fit"
    with pytest.raises(StageFailed):
        job.make()
    last = job.work.folder / "run" / "lightning_logs" / "version_0" / "checkpoints" / "last.ckpt"
    last.parent.mkdir(parents=True)
    last.touch()
    programs.fails = ""
    job.make()
    assert programs.names == ["fit", "fit", "test"]
    assert programs.commands[1][-2:] == ["--ckpt_path", str(last)]


def test_the_tables_hold_what_the_reports_and_the_paper_say(tmp_path, programs, capsys):
    (tmp_path / "data" / "laptop" / "procedural-complete").mkdir(parents=True)
    (tmp_path / "data" / "laptop" / "procedural-complete" / "manifest.json").touch()
    build = tmp_path / "build"
    options = ["--build", str(build), "--root", str(tmp_path / "data"), "--seeds", "2"]
    assert command.main([*options, "--methods", "oracle_icp"]) == 0
    text = (build / "laptop-complete.md").read_text()
    assert text in capsys.readouterr().out
    unfolded, legacy, each = (line for line in text.splitlines() if line.startswith("| Oracle ICP"))
    # Seeds 4.0 and 5.0, each with 1.0 over objects: Student's quantile of one degree of freedom is 12.7.
    half = math.hypot(1.0, 12.7062 * math.sqrt(0.5) / math.sqrt(2))
    assert f"| 4.5 [0.0, {4.5 + half:.1f}] |" in unfolded
    assert each.startswith("| Oracle ICP | 4.0 / 5.0 |")
    assert "clouds, part labels, part poses, parts at test | 2 |" in unfolded
    assert unfolded.endswith("| 60 | 0.500 | 12 345 |")
    assert unfolded.count("–") == 3  # axis, pivot, state: ICP predicts no joints
    assert legacy.startswith("| Oracle ICP | 3.5 / 5.5 | 43.3 / 44.0 |")
    with (build / "laptop-complete.csv").open() as file:
        rows = {(row["quantity"], row["of"]): row for row in csv.DictReader(file)}
    assert float(rows["r_err_deg", "lid"]["mean"]) == 5.5 and rows["r_err_deg", "lid"]["seeds"] == "0 1"
    assert rows["r_err_deg", "lid"]["of_seeds"] == "5.0 6.0"
    (row,) = json.loads((build / "laptop-complete.json").read_text())["rows"]
    assert row["printed"]["seg_miou"] == 56.2 and row["parameters"] == 12345
    assert matplotlib.image.imread(build / "laptop-complete.png").std() > 0


def test_seconds_of_a_gpu_are_told_apart(tmp_path, programs, monkeypatch):
    (tmp_path / "data" / "laptop" / "procedural-complete").mkdir(parents=True)
    (tmp_path / "data" / "laptop" / "procedural-complete" / "manifest.json").touch()
    options = ["--build", str(tmp_path / "build"), "--root", str(tmp_path / "data"), "--methods", "oracle_epn"]
    report = _report()
    for device, seconds in (("CPU", "60"), ("NVIDIA H200", "60 (NVIDIA H200)")):
        monkeypatch.setattr(Job, "report", lambda _job, _column, on=device: report | {"trained_on": on})
        assert command.main(options) == 0
        assert f"| {seconds} | 0.500 |" in (tmp_path / "build" / "laptop-complete.md").read_text()


def test_trainings_are_tested_on_other_objects_too(tmp_path, programs, capsys):
    for source in ("procedural", "partnet-mobility"):
        (folder := tmp_path / "data" / "laptop" / f"{source}-complete").mkdir(parents=True)
        (folder / "manifest.json").touch()
    build = tmp_path / "build"
    options = ["--build", str(build), "--root", str(tmp_path / "data"), "--methods", "oracle_icp"]
    assert command.main(options) == 0
    assert command.main([*options, "--test-source", "partnet-mobility"]) == 0
    assert len(programs.commands) == 2  # the training is not repeated
    row = next(line for line in capsys.readouterr().out.splitlines()[::-1] if line.startswith("| Oracle ICP | c"))
    assert "| 14.0 [13.0, 15.0] |" in row
    text = (build / "laptop-complete-tested-on-partnet-mobility.md").read_text()
    assert text.startswith("# laptop, complete clouds, tested on objects from partnet-mobility\n")
    assert "43.3" not in text  # the paper's, of its own objects
    assert "| 4.0 [3.0, 5.0] |" in (build / "laptop-complete.md").read_text()
    assert command.main([*options, "--test-source", "hoi4d"]) == 2
    assert "make data CAT=laptop VIEW=complete SOURCE=hoi4d" in capsys.readouterr().err


def test_results_that_are_kept_are_not_measured_again(tmp_path, programs, capsys):
    (tmp_path / "data" / "laptop" / "procedural-complete").mkdir(parents=True)
    (tmp_path / "data" / "laptop" / "procedural-complete" / "manifest.json").touch()
    kept, methods = tmp_path / "kept", ("--methods", "oracle_icp", "op_align")
    first = [*methods, "--root", str(tmp_path / "data"), "--build", str(tmp_path / "one"), "--measured", str(kept)]
    assert command.main([*first, "--seeds", "2"]) == 0
    table = (tmp_path / "one" / "laptop-complete.md").read_text()
    assert sorted(file.name for file in (kept / "laptop-complete").iterdir()) == [
        f"{name}-{seed}.json" for name in ("op_align", "oracle_icp") for seed in (0, 1)
    ]
    count = len(programs.commands)
    # Another machine, without the data: one more seed would need them, the same two do not.
    elsewhere = [*methods, "--build", str(tmp_path / "two"), "--measured", str(kept)]
    assert command.main([*elsewhere, "--seeds", "2"]) == 0
    assert len(programs.commands) == count
    assert (tmp_path / "two" / "laptop-complete.md").read_text() == table
    assert command.main([*first, "--seeds", "3"]) == 0
    assert len(programs.commands) == count + 2 and (kept / "laptop-complete" / "op_align-2.json").is_file()
    # Of another effort they are other results, and without the option nothing is known of them.
    other = Job(_setting(tmp_path, steps=7), "oracle_icp", 0)
    same = Job(_setting(tmp_path), "oracle_icp", 0)
    assert Measured(kept).knows(same) and not Measured(kept).knows(other) and not Measured().knows(same)
    (kept / "laptop-complete" / "op_align-0.json").write_text("{}")
    capsys.readouterr()
    assert command.main([*elsewhere, "--seeds", "2"]) == 2
    assert "op_align-0.json" in capsys.readouterr().err


def test_what_there_is_can_be_shown_before_all_is_finished(tmp_path, programs):
    (tmp_path / "data" / "laptop" / "procedural-complete").mkdir(parents=True)
    (tmp_path / "data" / "laptop" / "procedural-complete" / "manifest.json").touch()
    options = ["--root", str(tmp_path / "data"), "--build", str(tmp_path / "build"), "--methods", "oracle_icp"]
    assert command.main(options) == 0
    count = len(programs.commands)
    assert command.main([*options, "op_align", "--seeds", "3", "--show"]) == 0
    assert len(programs.commands) == count
    text = (tmp_path / "build" / "laptop-complete.md").read_text()
    oracle, other = (line for line in text.splitlines() if line.startswith(("| Oracle ICP | c", "| OP-Align | c")))
    assert "| 1 | 4.0 [3.0, 5.0] |" in oracle and "| 0 | – | – |" in other


def test_of_a_recipe_all_ways_to_predict_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(Job, "finished", True)
    shifts = {"no_network": 0.0, "network": 1.0, "network_registered": 2.0}
    monkeypatch.setattr(Job, "report", lambda _self, column: _report(shifts[column]))
    job, measured = Job(_setting(tmp_path), "staged", 0), Measured(tmp_path / "kept")
    (file,) = measured.keep([job])
    assert measured.keep([job]) == [] and file == measured.file(job)
    for column, shift in shifts.items():
        assert measured.report(job, column)["r_err_deg"]["mean"] == 4.0 + shift


def test_what_is_not_defined_or_not_there_is_a_dash(tmp_path, monkeypatch):
    half = Row("half", "Half", "half", (), ("seg_miou",), views=("complete",))
    monkeypatch.setattr("articulate_ssl.comparison.results.rows_of", lambda _name: [half])
    results = collect(_setting(tmp_path, "partial"), ["half"], [0], ["it failed; its log says why"])
    assert results.rows == (RowResult(half),) and results.samples == 0
    text = as_markdown(results)
    assert text.count("–") >= 12 + 12 and "- it failed; its log says why" in text


@pytest.mark.parametrize(("more", "given"), [({}, "clouds"), ({"setting": "multi-state"}, "clouds, which clouds show")])
def test_a_row_says_if_it_was_given_which_clouds_show_one_object(tmp_path, monkeypatch, more, given):
    monkeypatch.setattr(Job, "finished", True)
    monkeypatch.setattr(Job, "report", lambda _self, _column: _report() | more)
    text = as_markdown(collect(_setting(tmp_path, "complete"), ["staged"], [0], []))
    row = next(line for line in text.splitlines() if line.startswith("| ours, staged"))
    assert f"| {given}" in row and ("one object" in row) == bool(more)
    views = as_markdown(collect(_setting(tmp_path, "partial"), ["staged", MULTI_STATE], [0], []))
    of_views = [line for line in views.splitlines() if line.startswith("| ours")]
    assert ["complete scans" in line for line in of_views[:6]] == [False] * 3 + [bool(more)] * 3


def test_rows_stand_in_the_band_of_the_most_that_they_are_given(tmp_path, monkeypatch):
    monkeypatch.setattr(Job, "finished", True)
    told = {MULTI_STATE: {"setting": "multi-state"}}
    monkeypatch.setattr(Job, "report", lambda job, _column: _report() | told.get(job.learner, {}))
    names = ["staged", MULTI_STATE, "bae_net", "npcs_epn", "oracle_icp"]
    results = collect(_setting(tmp_path, "partial"), names, [0], [])
    bands = {row.row.learner: LEVELS[level(row)] for row in results.rows}
    assert [bands[name] for name in names] == list(LEVELS)


def test_failures_and_bad_names_are_exit_codes(tmp_path, programs, capsys):
    options = ["--build", str(tmp_path), "--methods"]
    assert command.main([*options, "magic"]) == 2
    assert "npcs_epn" in capsys.readouterr().err
    programs.fails = "render.generate"
    assert command.main([*options, "oracle_icp"]) == 1


def test_the_papers_tables_are_whole():
    tables = yaml.safe_load(Path(jobs_module.__file__).with_name("paper_tables.yaml").read_text())
    assert set(tables) == {"complete", "partial"}
    # Averages that the paper prints over its categories' parts or joints, in its own rounding.
    for view, method, quantity, average in (
        ("complete", "npcs_epn", "r_err_deg", 5.38),
        ("complete", "paper", "r_err_deg", 7.90),
        ("complete", "oracle_icp", "r_err_deg", 46.11),
        ("complete", "npcs_kpconv", "r_err_deg", 50.74),
        ("complete", "oracle_epn", "r_err_deg", 37.81),
        ("complete", "paper", "seg_miou", 73.26),
        ("complete", "bsp_net", "seg_miou", 66.22),
        ("complete", "epn_whole", "chamfer_l1", 0.036),
        ("complete", "paper", "t_err", 0.065),
        ("partial", "npcs_epn", "r_err_deg", 13.34),
        ("partial", "paper", "r_err_deg", 8.36),
    ):
        values = [category[method][quantity] for category in tables[view].values()]
        flat = [figure for value in values for figure in (value if isinstance(value, list) else [value])]
        assert sum(flat) / len(flat) == pytest.approx(average, rel=0.03), (view, method, quantity)


def test_what_is_finished_is_kept_before_the_rest_is(tmp_path, programs, monkeypatch):
    """As a machine may be lost before that."""
    (tmp_path / "data" / "laptop" / "procedural-complete").mkdir(parents=True)
    (tmp_path / "data" / "laptop" / "procedural-complete" / "manifest.json").touch()
    make = Job.make

    def cut_off(job, *args):
        if job.learner == "op_align":
            raise KeyboardInterrupt
        make(job, *args)

    monkeypatch.setattr(Job, "make", cut_off)
    options = ["--root", str(tmp_path / "data"), "--build", str(tmp_path / "one"), "--measured", str(tmp_path / "kept")]
    with contextlib.suppress(KeyboardInterrupt):
        command.main(["--methods", "oracle_icp", "op_align", *options])
    assert [file.name for file in (tmp_path / "kept" / "laptop-complete").iterdir()] == ["oracle_icp-0.json"]


def test_results_keep_the_order_of_the_rows(tmp_path, programs):
    setting = _setting(tmp_path)
    for name in ("op_align", "oracle_icp"):
        Job(setting, name, 0).make()
    results = collect(setting, ["op_align", "oracle_icp"], [0], [])
    assert isinstance(results, Results)
    assert [result.row.name for result in results.rows] == ["op_align", "oracle_icp"]
    assert results.rows[0].value("axis_err_deg") is not None and results.rows[1].value("axis_err_deg") is None


def test_a_dask_cluster_does_the_same(tmp_path, programs):
    distributed = pytest.importorskip("dask.distributed")
    jobs = [Job(_setting(tmp_path), name, 0) for name in ("oracle_icp", "op_align")]
    programs.fails = "op_align"
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=1, processes=False, dashboard_address=None
    ) as cluster:
        failed = do_jobs(jobs, 1, cluster.scheduler_address)
    assert [job.finished for job in jobs] == [True, False]
    assert [job.learner for job in failed] == ["op_align"]


def test_a_scheduler_that_is_not_there_is_named(tmp_path, monkeypatch):
    distributed = pytest.importorskip("dask.distributed")

    def nobody(address):
        raise OSError("timed out")

    monkeypatch.setattr(distributed, "Client", nobody)
    with pytest.raises(ValueError, match="tcp://nowhere:1"):
        do_jobs([Job(_setting(tmp_path), "oracle_icp", 0)], 1, "tcp://nowhere:1")
