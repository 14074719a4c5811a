import csv
import io

import pytest
import torch
from articulated_world import articulated_labels, part_turn

from articulate_ssl.baselines.perfect_oracle import perfect_oracle
from articulate_ssl.metrics import ArticulatedPoseMetrics, calibrate
from articulate_ssl.metrics.objects import as_csv, half_of_flips

NAMES = [f"object-{i}" for i in range(9)]


def of_objects(flips: list[int], clouds: int = 10) -> dict[str, torch.Tensor]:
    rate = torch.tensor(flips, dtype=torch.float64) / clouds
    number = torch.arange(len(flips))
    return {"instance": number, "samples": torch.full_like(number, clouds), "r_err_deg": 180 * rate, "flip_rate": rate}


def test_means_over_the_clouds_of_every_object_are_those_of_all():
    labels = articulated_labels(clouds=24, num_parts=3)
    labels["instance"] = torch.tensor([0, 2, 5]).repeat(8)
    truth = perfect_oracle(labels)
    metrics = ArticulatedPoseMetrics(calibrate(truth, labels), replicates=2)
    turned = part_turn(truth, torch.where(labels["instance"] == 2, 120.0, 10.0), part=0)
    metrics.update(turned[:10], {name: value[:10] for name, value in labels.items()})
    metrics.update(turned[10:], {name: value[10:] for name, value in labels.items()})
    found, every = metrics.per_object(), metrics.compute()
    assert found["instance"].tolist() == [0, 2, 5]
    assert found["samples"].tolist() == [8, 8, 8]
    assert found["flip_rate"].tolist() == [0, 1, 0]
    assert found["r_err_deg"].tolist() == pytest.approx([10 / 3, 40, 10 / 3], abs=1e-3)
    for name, values in found.items():
        if name in every and isinstance(every[name], dict):
            mean = every[name]["mean"]
            assert float(values.mean()) == pytest.approx(mean, abs=1e-9) if mean is not None else values.isnan().all()


def test_the_worst_object_comes_first_and_what_does_not_exist_is_empty():
    objects = of_objects([0, 9, 4]) | {"pivot_err": torch.tensor([0.5, torch.nan, 0.25])}
    lines = list(csv.DictReader(io.StringIO(as_csv(objects, NAMES))))
    assert [line["object"] for line in lines] == ["object-1", "object-2", "object-0"]
    assert [line["pivot_err"] for line in lines] == ["", "0.25", "0.5"]
    assert [float(line["flip_rate"]) for line in lines] == [0.9, 0.4, 0]
    assert {line["samples"] for line in lines} == {"10"}


@pytest.mark.parametrize(
    ("flips", "said"),
    [
        ([1, 9, 4], "9 of 14 flips are of 1 of 3 objects: object-1"),
        ([3, 0, 3], "3 of 6 flips are of 1 of 3 objects: object-0"),
        ([2, 2, 2], "4 of 6 flips are of 2 of 3 objects: object-0, object-1"),
        ([1] * 9, "5 of 9 flips are of 5 of 9 objects: " + ", ".join(NAMES[:5])),
        ([0, 0], None),
    ],
)
def test_the_fewest_objects_with_half_of_the_flips_are_named(flips, said):
    assert half_of_flips(of_objects(flips), NAMES) == said


def test_of_many_objects_some_are_named():
    names = [f"object-{i}" for i in range(12)]
    assert half_of_flips(of_objects([1] * 12), names) == (
        "6 of 12 flips are of 6 of 12 objects: object-0, object-1, object-2, object-3, object-4 and 1 more"
    )
