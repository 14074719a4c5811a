"""Results that outlive the machine that measured them: a small file per method or recipe and seed, kept with the code.

Trainings are hours, and what they leave in a build folder is lost with it. With `--measured FOLDER` reports of
finished jobs are kept there (`<category>-<view>/<method>-<seed>.json`), and a job of which there is one is not run
again. Without it everything is measured anew.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from articulate_ssl.comparison.jobs import Job
from articulate_ssl.comparison.rows import rows_of
from articulate_ssl.pretrained.rebuild import commit_of
from datamodules.atomic import atomic_write

_LEFT_OUT = ("calibration", "columns", "checkpoint")  # of a report: no table reads them


@dataclass(frozen=True)
class Measured:
    """A folder of kept reports.

    Attributes:
        folder: None keeps and knows nothing.
    """

    folder: Path | None = None

    def file(self, job: Job) -> Path:
        """Where the report of a job is kept."""
        return self.folder / job.setting.name / f"{job.learner}-{job.seed}.json"

    def knows(self, job: Job) -> bool:
        """Whether a report of such a job, of the same effort, is kept."""
        return self._kept(job) is not None

    def report(self, job: Job, column: str | None) -> dict[str, Any] | None:
        """`Job.report` as it is kept; None for what is not."""
        kept = self._kept(job)
        return None if kept is None else kept["reports"][column or job.learner]

    def keep(self, jobs: Iterable[Job]) -> list[Path]:
        """Keep the reports of finished jobs that are not kept yet; returns their files."""
        written = []
        for job in jobs:
            if self.folder is None or self.knows(job) or not job.finished:
                continue
            columns = [row.column for row in rows_of(job.learner)]
            reports = {column or job.learner: _without(job.report(column)) for column in columns}
            content = {"effort": _effort(job), "commit": commit_of(Path(__file__).parent), "reports": reports}
            (file := self.file(job)).parent.mkdir(parents=True, exist_ok=True)
            with atomic_write(file) as stream:
                stream.write((json.dumps(content, indent=1, allow_nan=False) + "\n").encode())
            written.append(file)
        return written

    def _kept(self, job: Job) -> dict[str, Any] | None:
        if self.folder is None or not (file := self.file(job)).is_file():
            return None
        try:
            kept = json.loads(file.read_text())
            effort, _ = kept["effort"], kept["reports"]
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{file}: no results that were kept ({error!r}); delete it to measure them anew") from None
        return kept if effort == _effort(job) else None


def _effort(job: Job) -> dict[str, Any]:
    """What results of the same category, view and seed may differ by."""
    setting = job.setting
    configs = [str(file) for file in setting.configs]
    return {"samples": setting.samples, "steps": setting.steps, "configs": configs, "data": list(setting.data_options)}


def _without(report: dict[str, Any]) -> dict[str, Any]:
    joint_type = {"calibration": {"joint_type": report["calibration"]["joint_type"]}}
    return {name: value for name, value in report.items() if name not in _LEFT_OUT} | joint_type
